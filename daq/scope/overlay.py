"""An earlier run behind the one that is shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource

from daq.scope.history import View
from daq.scope.planes import PlaneSources
from daq.scope.watch import FollowedLog

_POINTS = 500  # stretches drawn at least over the width of the page
_MARGIN = 0.5  # of the width that is drawn beyond either edge
_WIDEST = 6.0  # widths that may be drawn before it is looked at more closely


class EarlierRun:
    """A run's curves over the same time as those of the run that is shown.

    columns: those that are drawn, of the run that is shown; a run without one has a gap.
    """

    def __init__(self, path: Path, color: str, columns: tuple[str, ...]) -> None:
        self.log = FollowedLog(path)
        self.color = color
        self.samples = ColumnDataSource({name: [] for name in {"t", *columns}})
        self.planes = PlaneSources.of(color)
        self.columns = columns
        self._drawn: tuple[float, float] | None = None
        self._rows = 0

    @property
    def text(self) -> str:
        """Its name, and how long it is: it may have ended before what is shown."""
        history = self.log.history
        if history is None or not history.n_rows:
            return f"{self.log.name}, without a sample"
        return f"{self.log.name}, {history.span[1]:.5g} s"

    def draw(self, start: float, end: float) -> bool:
        """Draw what lies between two times [s], where that is not drawn yet; whether it was not."""
        self.log.read()
        history, width = self.log.history, end - start
        if history is None or not history.n_rows or not width > 0.0:
            return False
        if self._rows == history.n_rows and self._drawn is not None:
            first, last = self._drawn
            if first <= start and end <= last and last - first <= _WIDEST * width:
                return False
        margin = _MARGIN * width
        self._drawn, self._rows = (start - margin, end + margin), history.n_rows
        points = round((1.0 + 2.0 * _MARGIN) * _POINTS)
        self.samples.data = self._data(history.view(*self._drawn, points))
        return True

    def _data(self, view: View) -> dict[str, Any]:
        columns = self.log.tail.columns
        each = 1 if view.step == 1 else 2
        data: dict[str, Any] = {"t": np.repeat(view.time, each)}
        for name in self.columns:
            if name in columns:
                place = columns.index(name)
                both = np.stack([view.low[:, place], view.high[:, place]], axis=1)
                data[name] = both[:, :each].ravel()
            else:
                data[name] = np.full(len(data["t"]), np.nan)
        return data
