"""JSON Schemas of the configuration models, as editors read them (draft 7, without references)."""

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

Schema = dict[str, Any]
DRAFT = "http://json-schema.org/draft-07/schema#"
# What pydantic calls a bound that it could not put where the number is.
_BOUNDS = {
    "gt": "exclusiveMinimum",
    "ge": "minimum",
    "lt": "exclusiveMaximum",
    "le": "maximum",
}


def json_schema(model: type[BaseModel]) -> Schema:
    """The schema of a model's content; a ``description`` ends with the unit, if there is one."""
    raw = model.model_json_schema()
    schema: Schema = _clean(raw, raw.get("$defs", {}))
    return schema


def partial(schema: Schema) -> Schema:
    """The schema of content of which any part may be left out."""
    return {
        key: _partial(value) for key, value in schema.items() if key not in {"required", "oneOf"}
    }


def unit_in(schema: Schema) -> str | None:
    """The unit of the numbers at a key, wherever in its schema it stands."""
    declared: str | None = schema.get("unit")
    return declared or next((unit for inner in _inner(schema) if (unit := unit_in(inner))), None)


def branches(schema: Schema) -> list[Schema]:
    """What may stand at a key, one schema for each kind, without null."""
    return [s for s in schema.get("anyOf", [schema]) if s.get("type") != "null"]


def _clean(node: Any, defs: Mapping[str, Any]) -> Any:
    if isinstance(node, list):
        return [_clean(item, defs) for item in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        target = defs[node["$ref"].rpartition("/")[2]]
        node = {**target, **{key: value for key, value in node.items() if key != "$ref"}}
    cleaned: Schema = {}
    for key, value in node.items():
        if key == "properties":
            cleaned[key] = {name: _with_unit(_clean(item, defs)) for name, item in value.items()}
        elif key == "prefixItems":
            cleaned["items"] = _clean(value, defs)
        elif key in {"default", "enum", "const", "examples"}:
            cleaned[key] = value
        elif key not in {"title", "$defs", "discriminator"}:
            cleaned[_BOUNDS.get(key, key)] = _clean(value, defs)
    return cleaned


def _with_unit(schema: Schema) -> Schema:
    unit = unit_in(schema)
    if unit in {None, "1"} or "description" not in schema or "properties" in schema:
        return schema
    return {**schema, "description": f"{schema['description']} [{unit}]"}


def _inner(schema: Schema) -> Iterator[Schema]:
    items = schema.get("items", [])
    yield from schema.get("anyOf", [])
    yield from items if isinstance(items, list) else [items]
    if isinstance(schema.get("additionalProperties"), dict):
        yield schema["additionalProperties"]


def _partial(value: Any) -> Any:
    if isinstance(value, dict):
        return partial(value)
    return [_partial(item) for item in value] if isinstance(value, list) else value
