"""The controls of a page's trigger."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from bokeh.models.widgets import NumericInput, RadioButtonGroup, Select, Toggle

from daq.logs.columns import UNITS
from daq.scope.trigger import Trigger

_EDGES = ("no trigger", "rises", "falls")


class TriggerControls:
    """Direction, channel and level of a trigger; the latter are seen where there is one.

    middle: of the values of a channel, the level that is offered first. changed: is called with
    whether there was a trigger before.
    """

    def __init__(self, middle: Callable[[str], float], changed: Callable[[bool], None]) -> None:
        self.trigger: Trigger | None = None
        self._middle, self._changed = middle, changed
        self._edge = RadioButtonGroup(labels=list(_EDGES), active=0, name="edge")
        self._channel = Select(width=220, name="trigger channel", visible=False)
        self._level = NumericInput(mode="float", width=90, name="level", visible=False)
        self._once = Toggle(label="hold at the next", name="once", width=130, visible=False)
        self._edge.on_change("active", self._offer_level)
        self._channel.on_change("value", self._offer_level)
        self._level.on_change("value", lambda attr, old, new: self.renew())
        self._once.on_click(lambda active: self.renew())
        self.parts = (self._edge, self._channel, self._level, self._once)

    @property
    def holds(self) -> bool:
        """Whether the page is to stand still at the next passage."""
        return bool(self._once.active)

    def offer(self, channels: Sequence[str]) -> None:
        """Let one of these channels be chosen."""
        options: list[Any] = [
            (name, f"{name} [{UNITS[name]}]" if UNITS.get(name) else name) for name in channels
        ]
        self._channel.options = options
        if self._channel.value not in channels:
            self._channel.value = channels[0] if channels else ""

    def renew(self) -> None:
        """The trigger that the controls say, before its first passage."""
        on = bool(self._edge.active) and bool(self._channel.value)
        for control in self.parts[1:]:
            control.visible = on
        before, level = self.trigger is not None, self._level.value
        self.trigger = None
        if on and level is not None:
            rising = _EDGES[self._edge.active or 0] == "rises"
            self.trigger = Trigger(self._channel.value, float(level), rising)
        if before or self.trigger is not None:
            self._changed(before)

    def _offer_level(self, attr: str, old: Any, new: Any) -> None:
        """Start in the middle of another channel."""
        if attr == "value" or self._level.value is None:
            middle = self._middle(self._channel.value)
            level = float(f"{middle:.3g}") if math.isfinite(middle) else 0.0
            if level != self._level.value:
                self._level.value = level  # renews
                return
        self.renew()
