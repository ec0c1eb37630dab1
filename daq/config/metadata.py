"""What a person says of a run: who, on what, why."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, Self

from pydantic import ConfigDict, Field, field_validator, model_validator

from daq.config.base import Section

_KEY = re.compile(r"[^\W\d]\w*")
_ASSIGNMENT = re.compile(rf"\s*({_KEY.pattern})\s*=(.*)", re.DOTALL)
_LONGEST = 2000  # characters of a value
FACTS = (
    "folder", "started", "status", "reason", "protocol", "rig", "device", "model", "trust",
    "predictions", "parameters",
)  # fmt: skip
"""What a run is known by without being noted: nothing can be noted under these keys."""
SYNONYMS = {"tag": "tags", "run": "folder"}  # by which a catalogue is asked as well


class Metadata(Section):
    """Operator, sample, note and tags of a run, and any keys of a lab's own."""

    model_config = ConfigDict(extra="allow")

    operator: str = Field("", max_length=200, description="who runs it")
    sample: str = Field(
        "", max_length=200, description="what is on the rig, such as a brake's number"
    )
    note: str = Field("", max_length=_LONGEST, description="anything else worth knowing")
    tags: tuple[str, ...] = Field((), max_length=50, description="words to find the run by")

    @field_validator("tags")
    @classmethod
    def _words(cls, tags: tuple[str, ...]) -> tuple[str, ...]:
        for tag in tags:
            if not tag.strip() or "," in tag or len(tag) > 80:
                raise ValueError(f"{tag!r} is no tag; write a word of at most 80 letters")
        return tuple(dict.fromkeys(tag.strip() for tag in tags))

    @model_validator(mode="after")
    def _keys_can_be_asked_for(self) -> Self:
        for key, value in (self.model_extra or {}).items():
            if not _KEY.fullmatch(key):
                raise ValueError(f"{key!r} is no key; write letters, digits and underscores")
            if key in FACTS or key in SYNONYMS:
                meant = SYNONYMS.get(key, key)
                raise ValueError(f"{key!r} means the run's own {meant}; choose another key")
            if not isinstance(value, str | int | float):
                raise ValueError(f"{key}: {value!r} is neither text nor a number")
            if isinstance(value, str) and len(value) > _LONGEST:
                raise ValueError(f"{key}: at most {_LONGEST} characters are possible")
        return self

    @property
    def content(self) -> dict[str, Any]:
        """What was said, by key; nothing that was not."""
        values = self.model_dump(mode="json")
        return {key: value for key, value in values.items() if value not in ("", [])}

    def amended(self, changes: Mapping[str, Any]) -> Metadata:
        """The same with other values; an empty one takes the key away.

        Raises ValueError (pydantic.ValidationError) for a value that cannot be.

        >>> Metadata(operator="Ann").amended({"operator": "", "brake": 3}).content
        {'brake': 3}
        """
        values = {**self.content, **changes}
        return Metadata(**{key: value for key, value in values.items() if value not in ("", [])})


def changes_of(notes: Iterable[str]) -> dict[str, Any]:
    """Changes that ``KEY=VALUE`` and plain text ask for; text is the note, tags are a list.

    >>> changes_of(["operator=Ann", "temperature=23.5", "tags=new, warm", "brushes replaced"])
    {'operator': 'Ann', 'temperature': 23.5, 'tags': ['new', 'warm'], 'note': 'brushes replaced'}
    """
    changes: dict[str, Any] = {}
    for text in notes:
        assignment = _ASSIGNMENT.fullmatch(text)
        if assignment is None:
            changes["note"] = "\n".join(filter(None, (changes.get("note", ""), text.strip())))
        else:
            key, value = assignment[1], assignment[2].strip()
            changes[key] = _value(key, value)
    return changes


def _value(key: str, text: str) -> Any:
    if key == "tags":
        return [tag.strip() for tag in text.split(",") if tag.strip()]
    if key in Metadata.model_fields:
        return text
    try:
        return int(text) if re.fullmatch(r"-?(0|[1-9]\d*)", text) else float(text)
    except ValueError:
        return text
