"""Shared base of the configuration models."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator


class Section(BaseModel):
    """A group of settings: unknown keys are mistakes, values do not change, infinity is none."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _truth_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        # YAML reads yes, no, on and off as truth values, and pydantic those as 1 and 0.
        if isinstance(value, bool):
            field = cls.model_fields[info.field_name or ""]
            if field.annotation is not bool:
                raise ValueError("yes, no, on, off, true and false are no value for this key")
        return value
