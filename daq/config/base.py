"""Shared base of the configuration models."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A group of settings: unknown keys are mistakes, values do not change, infinity is none."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
