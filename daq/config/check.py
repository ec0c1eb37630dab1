"""Configuration files against their models: every mistake at once, each with place and cure."""

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from daq.config.units import unit_of
from daq.config.yaml_file import Key, YamlFile, dotted
from daq.errors import ConfigError, Mistake, suggestion

Model = TypeVar("Model", bound=BaseModel)
Complaint = tuple[str, str]  # problem and cure
_MANY = 20  # mistakes that are told one by one
_SHOWN = 60  # characters of a value in a message
_DEEPEST = 6  # levels of sections in which a misplaced key is looked for


def validate(
    file: YamlFile,
    model: type[Model],
    content: Mapping[str, Any] | None = None,
    at: Key = (),
    others: Sequence[Mistake] = (),
) -> Model:
    """Check a file's content, or the part of it at a key, against a model.

    Raises one ConfigError that lists every mistake in the order of the file, ``others`` and keys
    that stand twice among them, each with line, column, key, value and cure.
    """
    data = file.content if content is None else content
    refuse([*file.repeated, *others, *mistakes(file, model, data, at)])
    return model.model_validate(data, context={"folder": file.path.parent})


def mistakes(
    file: YamlFile, model: type[BaseModel], content: Mapping[str, Any], at: Key = ()
) -> list[Mistake]:
    """What is wrong with the part of a file at a key by a model; one for each key."""
    try:
        model.model_validate(content, context={"folder": file.path.parent})
    except ValidationError as error:
        errors = error.errors(include_url=False)
        first = _Explainer(file, model, content, at).mistakes(errors[:_MANY])
        return [*first, _More("", file=file.path, count=len(errors) - _MANY)]
    return []


@dataclass(frozen=True)
class _More(Mistake):
    """In place of mistakes beyond those that are explained, none where the count is not above 0."""

    count: int = 0


def refuse(mistakes: Sequence[Mistake]) -> None:
    """Raise a ConfigError of the mistakes, if any: what was typed, then in the file's order.

    Of more than anybody reads at once, it has the first and the number of the others.
    """
    plain = {mistake for mistake in mistakes if not isinstance(mistake, _More)}
    if not plain:
        return
    ordered = sorted(plain, key=lambda each: (each.line or 0, each.column or 0, each.text))
    n_more = sum(max(each.count, 0) for each in mistakes if isinstance(each, _More))
    n_more += len(ordered[_MANY:])
    summary = [Mistake(f"and {n_more} more mistakes", file=ordered[0].file)] if n_more else []
    raise ConfigError.of([*ordered[:_MANY], *summary])


# Keys by which each kind of file is known when it is given in another's place, and the cure.
_SETTINGS = "an identification's settings"
_SEARCH_KEYS = {"model", "columns", "ranges", "fixed", "population", "preset"}
_QUESTION_KEYS = {"targets", "precision", "criterion", "time", "plant", "protocols", "noise"}
_KINDS = {
    "an experiment": ({"protocol"}, "name it behind rig run or rig check"),
    "a rig": ({"backend", "limits", "sensors"}, "give it with --rig"),
    "a torque controller's settings": ({"controller"}, "give it to rig tune"),
    _SETTINGS: (_SEARCH_KEYS, "give it with --config"),
    "a design's question": (_QUESTION_KEYS, "name it behind rig design"),
}


_RESULT_KEYS = {"verdict", "metrics"}  # which all results have, and no file that is written by hand
_OTHER_CURE = "give it with --parameters where a command has that"
_RESULT_CURE = (
    "give --config the file of settings, and a result with --given to keep what it holds, or with "
    "--parameters where a command has that"
)


def refuse_other_kind(file: YamlFile, wanted: str) -> None:
    """Raise ConfigError for a file of another kind than the wanted one, named as in ``_KINDS``."""
    if file.content.keys() >= _RESULT_KEYS:
        should = "its settings" if wanted == _SETTINGS else wanted
        problem = f"this is a result of an identification, and should be {should}"
        cure = _RESULT_CURE if wanted == _SETTINGS else _OTHER_CURE
        raise ConfigError.of([replace(file.mistake(("verdict",), problem, cure), key="")])
    if any(key in file.content for key in _KINDS[wanted][0]):
        return
    for kind, (marks, cure) in _KINDS.items():
        for key in file.content:
            if key in marks:
                problem = f"this file holds {kind}, and should hold {wanted}"
                raise ConfigError.of([replace(file.mistake((key,), problem, cure), key="")])


@dataclass(frozen=True)
class _Explainer:
    """Mistakes of the part of a file at a key, from pydantic's errors."""

    file: YamlFile
    model: type[BaseModel]
    content: Mapping[str, Any]
    at: Key

    def mistakes(self, errors: Sequence[ErrorDetails]) -> list[Mistake]:
        """One mistake for each key that is wrong."""
        complaints: dict[Key, list[Complaint]] = {}
        meant: set[Key] = set()
        for item, key in _of_best_branch([(item, self._key(item)) for item in errors]):
            if item["type"] in {"extra_forbidden", "invalid_key"}:
                names = self._fields(key[:-1])
                near = difflib.get_close_matches(str(key[-1]), names, n=1, cutoff=0.6)
                meant.update((*key[:-1], name) for name in near)
                complaints[key] = [("unknown key", self._cure(key, names, bool(near)))]
            else:
                complaints.setdefault(key, []).append(self._complaint(item, key))
        return [
            self.file.mistake((*self.at, *key), *_either(list(dict.fromkeys(alternatives))))
            for key, alternatives in complaints.items()
            # What is missing because it is misspelt is said once.
            if key not in meant or (*self.at, *key) in self.file.places
        ]

    def _key(self, item: ErrorDetails) -> Key:
        """The key an error is about, without what pydantic adds for branches of a union."""
        value: Any = self.content
        key: list[str | int] = []
        for part in item["loc"]:
            if isinstance(value, Mapping) and (part in value or str(part) in map(str, value)):
                value = value.get(part)
                key.append(str(part))
            elif isinstance(value, list) and isinstance(part, int) and part < len(value):
                value = value[part]
                key.append(part)
        if item["type"] == "missing" and isinstance(item["loc"][-1], str):
            key.append(item["loc"][-1])
        if item["type"] == "union_tag_invalid":
            key.append(item["ctx"]["discriminator"].strip("'"))
        return tuple(key)

    def _value(self, key: Key) -> Any:
        value: Any = self.content
        for part in key:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def _cure(self, key: Key, names: Sequence[str], is_near: bool) -> str:
        """Where an unknown key belongs, or what it may have meant."""
        sections = [at for at in _sections_with(self.model, str(key[-1])) if at != key[:-1]]
        if sections:
            places = ["at the left margin, under no other key"] if () in sections else []
            if under := " or ".join(dotted(section) for section in sections if section):
                places.append(f"under {under}")
            return f"it belongs {' or '.join(places)}"
        if not is_near and str(key[-1]).isdigit():
            return "between braces a comma begins the next key; write decimals with a point"
        return suggestion(str(key[-1]), names)

    def _complaint(self, item: ErrorDetails, key: Key) -> Complaint:
        kind = item["type"]
        about = self._about(key)
        if kind == "missing" and isinstance(item["loc"][-1], str):
            return "this key is missing", f"add it{about}"
        problem, cure = _complaint(kind, item, self._value(key), self._types(key))
        if kind == "value_error":  # a message of the project's own says what it needs to
            return problem, cure
        return (problem, f"{cure}{about}") if cure else (f"{problem}{about}", "")

    def _about(self, key: Key) -> str:
        """What a key means and its unit, as its field or that of the section it is in says."""
        while key:
            for kind in self._types(key[:-1]):
                field = getattr(kind, "model_fields", {}).get(key[-1])
                if field is not None and field.description:
                    unit = unit_of(field.annotation, field.metadata)
                    shown = f" [{unit}]" if unit not in {None, "1"} else ""
                    return f" ({field.description}{shown})"
            key = key[:-1]
        return ""

    def _fields(self, key: Key) -> list[str]:
        """Names of the keys allowed in a section."""
        names = [name for kind in self._types(key) for name in getattr(kind, "model_fields", {})]
        return list(dict.fromkeys(names))

    def _types(self, key: Key) -> list[Any]:
        """What may stand at a key: the alternatives that agree with what stands there."""
        kinds: list[Any] = [self.model]
        for depth, part in enumerate(key):
            section = self._value(key[:depth])
            kinds = [inner for kind in _agreeing(kinds, section) for inner in _inside(kind, part)]
        return _agreeing(kinds, self._value(key))


def _either(complaints: Sequence[Complaint]) -> Complaint:
    """What is wrong with a value by each type that it might have."""
    if len(complaints) == 1:
        return complaints[0]
    return " or ".join(Mistake(*complaint).text for complaint in complaints), ""


def _of_best_branch(
    errors: Sequence[tuple[ErrorDetails, Key]],
) -> Iterator[tuple[ErrorDetails, Key]]:
    """Errors without those of a union's branches that others fit better, as they go deeper."""
    for item, key in errors:
        branched = len(item["loc"]) > len(key)
        deeper = any(
            below[: len(key)] == key and len(below) > len(key) and len(inner["loc"]) > len(below)
            for inner, below in errors
        )
        if not (branched and deeper):
            yield item, key


def _alternatives(kind: Any) -> list[Any]:
    """The branches of a type, each without its marks."""
    if get_origin(kind) is Annotated:
        return _alternatives(get_args(kind)[0])
    if get_origin(kind) in {Union, UnionType}:
        return [branch for part in get_args(kind) for branch in _alternatives(part)]
    return [kind]


def _inside(kind: Any, part: str | int) -> list[Any]:
    """What may stand at a key or index of a value of a type."""
    if hasattr(kind, "model_fields"):
        field = kind.model_fields.get(part)
        return _alternatives(field.annotation) if field is not None else []
    inner = get_args(kind)
    if get_origin(kind) is dict:
        return _alternatives(inner[1])
    if get_origin(kind) is list:
        return _alternatives(inner[0])
    if get_origin(kind) is tuple and isinstance(part, int):
        return _alternatives(inner[min(part, len(inner) - 1)])
    return []


def _agreeing(kinds: list[Any], value: Any) -> list[Any]:
    """Of several models those whose fixed words stand in the value, all where none agrees."""

    def agrees(kind: Any) -> bool:
        return not isinstance(value, Mapping) or all(
            name not in value or value[name] in get_args(field.annotation)
            for name, field in getattr(kind, "model_fields", {}).items()
            if get_origin(field.annotation) is Literal
        )

    return [kind for kind in kinds if agrees(kind)] or kinds


def _sections_with(model: Any, name: str, at: Key = ()) -> list[Key]:
    """Sections below a model that have a key of that name."""
    if len(at) > _DEEPEST or not hasattr(model, "model_fields"):
        return []
    sections = [at] if name in model.model_fields else []
    for key, field in model.model_fields.items():
        for kind in _alternatives(field.annotation):
            sections += _sections_with(kind, name, (*at, key))
    return list(dict.fromkeys(sections))


_NUMBER, _WHOLE = "expected a number", "expected a whole number"
_LINES = "expected 'key: value' lines"
_EXPECTED = {
    **dict.fromkeys(("float_parsing", "float_type"), _NUMBER),
    "finite_number": "expected a finite number",
    **dict.fromkeys(("int_parsing", "int_parsing_size", "int_type", "int_from_float"), _WHOLE),
    **dict.fromkeys(("bool_parsing", "bool_type"), "expected true or false"),
    "string_type": "expected text",
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), _LINES),
    "list_type": "expected a list [a, b]",
    "greater_than": "it must be above {gt:g}",
    "greater_than_equal": "it must be at least {ge:g}",
    "less_than": "it must be below {lt:g}",
    "less_than_equal": "it must be at most {le:g}",
    "literal_error": "it must be {expected}",
    "union_tag_invalid": "it must be {expected_tags}",
    "union_tag_not_found": "its key {discriminator} is missing",
    "string_too_short": "it must not be empty",
    "string_too_long": "it must have at most {max_length} characters",
}
_NO_SECTION = {
    "list": "write its keys without '-' and brackets",
    "NoneType": "indent its keys below it",
}


def _complaint(kind: str, item: ErrorDetails, value: object, types: Sequence[Any]) -> Complaint:
    """What is wrong with a value, in plain English, with the value and a cure if it is plain."""
    context = item.get("ctx", {})
    expected = _EXPECTED.get(kind) or _expected_values(kind, context, types)
    if expected:
        problem = f"{expected.format(**context)}, found {_shown(value)}"
        return problem, _cure_of_value(kind, value, context, types)
    message = item["msg"].removeprefix("Value error, ")
    shown = "" if isinstance(value, Mapping) else f"; found {_shown(value)}"
    return message[0].lower() + message[1:] + shown, ""


def _expected_values(kind: str, context: Mapping[str, Any], types: Sequence[Any]) -> str:
    """How many values are expected; empty where that is not what is wrong."""
    if kind == "too_short" and context.get("field_type") != "Tuple":
        least = context["min_length"]
        return f"it needs at least {least} {'value' if least == 1 else 'values'}"
    if kind == "too_long" and context.get("field_type") != "Tuple":
        return f"it may have at most {context['max_length']} values"
    if kind in {"tuple_type", "too_short", "too_long", "missing"}:
        lengths = {len(get_args(each)) for each in types if get_origin(each) is tuple}
        if lengths == {2}:
            return "expected two values [low, high]"
        return f"expected {' or '.join(map(str, sorted(lengths)))} values [a, b, ...]"
    return ""


def _cure_of_value(
    kind: str, value: object, context: Mapping[str, Any], types: Sequence[Any]
) -> str:
    """What to write instead, where that is plain from the value."""
    if _EXPECTED.get(kind) in {_NUMBER, _WHOLE}:
        if re.match(r"[-+]?\d+,\d", str(value)):
            return "write a decimal point"
        has_unit = re.match(r"[-+]?[\d.]+\s*[^\W\d]", str(value))
        return "this one takes no unit" if has_unit else ""
    if _EXPECTED.get(kind) == _LINES:
        is_name = isinstance(value, str) and any(
            "column" in getattr(each, "model_fields", ()) for each in types
        )
        no_section = _NO_SECTION.get(type(value).__name__, "")
        return f"write {{column: {value}}}" if is_name else no_section
    if kind == "list_type" and isinstance(value, str | int | float):
        return f"write [{value}]"
    if kind == "string_type" and isinstance(value, int | float):
        return "put it in quotes"
    words = re.findall(r"'([^']+)'", context.get("expected", context.get("expected_tags", "")))
    near = difflib.get_close_matches(str(value), words, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else ""


def _shown(value: object) -> str:
    """A value as it stood in the YAML, shortened."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not math.isfinite(value):
        return f"{'-' * (value < 0)}.{'nan' if math.isnan(value) else 'inf'}"
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
