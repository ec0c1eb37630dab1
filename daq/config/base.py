"""Shared base of the configuration models."""

from collections.abc import Iterable
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator


class Section(BaseModel):
    """A group of settings: unknown keys are mistakes, values do not change, infinity is none."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _truth_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        # YAML reads yes, no, on and off as truth values, and pydantic those as 1 and 0.
        kind = cls.model_fields[info.field_name or ""].annotation
        if _has(kind, {bool, Any}):
            return value
        for name, part in _parts(value, kind):
            if isinstance(part, bool):
                # Of ``parameters``: parameter R_m.
                entry = f"{(info.field_name or '').removesuffix('s')} {name}: " if name else ""
                cure = "expected a number" if _has(kind, {float, int}) else "put text in quotes"
                raise ValueError(f"{entry}{cure}; YAML reads yes, no, on and off as true and false")
        return value


def _has(kind: Any, wanted: set[Any]) -> bool:
    return kind in wanted or any(_has(part, wanted) for part in get_args(kind))


def _parts(value: Any, kind: Any) -> Iterable[tuple[str, Any]]:
    """The value, or those in a list or under keys of its own; each behind its name, if any."""
    if isinstance(value, list):
        return [("", part) for part in value]
    if isinstance(value, dict) and get_origin(kind) is dict:
        return [(str(key), part) for key, part in value.items()]
    return [("", value)]
