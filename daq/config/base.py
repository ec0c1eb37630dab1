"""Shared base of the configuration models."""

from __future__ import annotations

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
        if _takes_truth(kind):
            return value
        for name, part in _parts(value, kind):
            if isinstance(part, bool):
                # Of ``parameters``: parameter R_m.
                one = f"{(info.field_name or '').removesuffix('s')} {name}: " if name else ""
                raise ValueError(f"{one}yes, no, on, off, true and false are no value for this key")
        return value


def _takes_truth(kind: Any) -> bool:
    return kind in {bool, Any} or any(_takes_truth(part) for part in get_args(kind))


def _parts(value: Any, kind: Any) -> Iterable[tuple[str, Any]]:
    """The value, or those in a list or under keys of its own; each behind its name, if any."""
    if isinstance(value, list):
        return [("", part) for part in value]
    if isinstance(value, dict) and get_origin(kind) is dict:
        return [(str(key), part) for key, part in value.items()]
    return [("", value)]
