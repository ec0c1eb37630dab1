"""One browser tab: what is drawn 30 times a second, and what the controls do."""

import math
import time
from html import escape
from typing import Any, cast

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, DoubleTap, MouseLeave, MouseMove, RangesUpdate, Reset, Tap
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, CustomJS, Range1d
from bokeh.models.widgets import Button, CheckboxGroup, Div, MultiChoice, RadioButtonGroup
from bokeh.plotting import figure

from daq.hal import FloatArray
from daq.scope import figures
from daq.scope.figures import Sources
from daq.scope.history import History, View, nothing, step_for
from daq.scope.looks import GREY, OTHERS, groups_of, quantity_of
from daq.scope.overlay import EarlierRun
from daq.scope.planes import TIME, VIEWS, Planes
from daq.scope.texts import FAILED, HELP, VALUE_FIELDS, heading, readout
from daq.scope.trigger import BEFORE, Trigger
from daq.scope.trigger_controls import TriggerControls
from daq.scope.watch import FollowedLog, Watch

_PERIOD = 28  # ms between updates: 30 a second and some, for no timer is exact
_POINTS = 500  # stretches drawn at least over the width of the page
_WINDOWS: dict[str, float | None] = {
    "0.2 s": 0.2, "2 s": 2.0, "10 s": 10.0, "60 s": 60.0, "whole run": None,
}  # fmt: skip
_USUAL, _TRIGGERED, _WHOLE = 2, 1, len(_WINDOWS) - 1
_VALUES_EVERY = 3  # updates between two of the table: ten a second can be read
_PLANE_EVERY = 6  # and of what is not drawn over time
_HEAD_EVERY = 15  # and of the heading, after which a browser lays the whole page out anew
_AHEAD = 2  # updates that may be on their way
_LOST = 1.0  # s after which an update that the browser has not echoed counts as never received
_STOP, _STOPPING = "Stop run", "Stopping …"
_WRAPPED = {"flex-wrap": "wrap"}  # of what has no room side by side
_WRAPPED_CHOICE = ".bk-input-group { flex-wrap: wrap; }"
_WIDE = "1 1 420px"  # a figure's share of the width, and what it does not go below
_MARGIN = 0.5  # of a held view's width that is drawn beyond its edges, to be there when it moves


class Page:
    """A tab that follows the watch, or holds a part of the run for a closer look."""

    def __init__(self, document: Document, watch: Watch) -> None:
        self._watch = watch
        self._log: FollowedLog | None = None
        self._columns: tuple[str, ...] = ()
        self._live = True
        self._ended = False
        self._zoomed_to: tuple[float, float] | None = None
        self._cursor: float | None = None
        self._mark: float | None = None
        self._drawn_step = self._drawn_end = 0
        self._tick = 0
        self._sources = Sources()
        self._time = Range1d(start=0.0, end=1.0, name="time")
        self._plots: list[figure] = []
        self._head = Div(name="head", sizing_mode="stretch_width")
        self._values = ColumnDataSource({name: [] for name in VALUE_FIELDS}, name="values")
        # The browser copies the number of an update when it has come to it.
        self._sent, self._seen = Range1d(start=0, name="sent"), Range1d(start=0, name="seen")
        self._sent.js_link("start", self._seen, "start")
        self._sent_at = 0.0
        self._button = Button(label="Pause", width=90, name="pause", button_type="primary")
        self._window = RadioButtonGroup(labels=list(_WINDOWS), active=_USUAL, name="window")
        self._button.on_click(lambda: self._hold() if self._live else self._follow())
        self._window.on_change("active", lambda attr, old, new: self._follow())
        self._view = RadioButtonGroup(labels=list(VIEWS), active=0, name="view")
        self._view.on_change("active", lambda attr, old, new: self._lay_out())
        self._channels = CheckboxGroup(
            inline=True, name="channels", stylesheets=[_WRAPPED_CHOICE], sizing_mode="stretch_width"
        )
        self._channels.on_change("active", lambda attr, old, new: self._lay_out())
        self._stop = Button(
            label=_STOP, width=110, name="stop", button_type="danger", visible=False
        )
        self._stop.on_click(self._stop_run)
        self._planes = Planes()
        self._trigger = TriggerControls(self._middle, self._wait_for_trigger)
        self._overlays: list[EarlierRun] = []
        self._behind = MultiChoice(
            placeholder="lay earlier runs behind", name="behind", max_items=len(OTHERS),
            option_limit=200, width=280, value=list(watch.others),
        )  # fmt: skip
        self._behind.on_change("value", lambda attr, old, new: self._lay_behind())
        self._figures = column(
            sizing_mode="stretch_width", name="figures", styles={"flex": _WIDE, "min-width": "0"}
        )
        controls = row(self._button, self._window, self._view, self._stop, styles=_WRAPPED)
        more = row(*self._trigger.parts, self._behind, styles=_WRAPPED)
        self._side = column(name="side")
        self._help = Div(text=HELP, width=380, styles={"color": GREY})
        body = row(self._figures, self._side, sizing_mode="stretch_width", styles=_WRAPPED)
        parts = (self._head, controls, more, self._channels, body)
        page = column(*parts, sizing_mode="stretch_width")
        page.tags = [self._sent, self._seen]
        document.add_root(page)
        document.title = "rig scope"
        done = CustomJS(code="document.getElementById('first')?.remove()")
        document.js_on_event(DocumentReady, done)  # the words before the figures
        self._document = document
        self._timer = document.add_periodic_callback(self._update, _PERIOD)
        self._update()

    def _update(self) -> None:
        try:
            self._advance()
        except Exception as error:  # would else stop the page without a word
            self._document.remove_periodic_callback(self._timer)
            self._head.text = f"<b>{escape(f'{FAILED} {type(error).__name__}: {error}')}</b>"

    def _advance(self) -> None:
        self._watch.poll()
        newest = self._watch.followed
        if self._live and newest is not self._log:
            self._show(newest)
        log = self._log
        if log is not None and log is not newest:
            log.look()
            log.read()
        if self._browser_is_behind():
            return
        if log is not None:
            self._draw(log)
            if self._tick % _PLANE_EVERY == 0:
                self._draw_plane(log)
        if self._tick % _VALUES_EVERY == 0:
            self._show_values()
        if self._tick % _HEAD_EVERY == 0:
            self._show_head()
        self._tick += 1
        self._sent.start, self._sent_at = self._tick, time.perf_counter()

    def _browser_is_behind(self) -> bool:
        """Whether the last updates have not been drawn yet: more of them would only queue up."""
        waiting = time.perf_counter() - self._sent_at < _LOST
        return waiting and self._tick - cast("int", self._seen.start) > _AHEAD

    def _show(self, log: FollowedLog | None) -> None:
        self._log = log
        self._ended = False
        self._set_mark(None)
        self._clear()
        self._trigger.renew()
        if log is not None:
            self._window.active = _USUAL if log.state.running else _WHOLE

    def _draw(self, log: FollowedLog) -> None:
        history = log.history
        if history is None:
            return
        if log.tail.columns != self._columns:
            self._make_figures(log.tail.columns)
        if not history.n_rows:
            return
        trigger = self._trigger.trigger
        if self._live and trigger is not None:
            self._draw_triggered(trigger, history, ended=not log.state.running)
        elif self._live:
            self._draw_live(log, history)
        elif self._zoomed_to is not None:
            start, end = self._zoomed_to
            self._zoomed_to = None
            margin = _MARGIN * (end - start)
            points = round(_POINTS * (1.0 + 2.0 * _MARGIN))
            self._replace(history.view(start - margin, end + margin, points), history.spread)
        drawn = [run.draw(*self._shown) for run in self._overlays]
        if any(drawn):
            self._fit()

    @property
    def _shown(self) -> tuple[float, float]:
        """The stretch of time that is shown [s]."""
        return cast("float", self._time.start), cast("float", self._time.end)

    def _draw_triggered(self, trigger: Trigger, history: History, ended: bool) -> None:
        """Draw what is around the newest passage of the trigger, once it is there."""
        width = list(_WINDOWS.values())[self._window.active or 0] or math.inf
        if not trigger.look(history, self._columns, width, ended):
            return
        assert trigger.at is not None
        start = trigger.at - BEFORE * width
        self._replace(history.view(start, start + width, _POINTS), history.spread)
        self._time.update(start=start, end=start + width)
        if self._trigger.holds:
            self._hold()

    def _draw_live(self, log: FollowedLog, history: History) -> None:
        """Draw the newest rows; all anew where stretches change their length."""
        ended = not log.state.running and log.loading is None
        if ended and not self._ended:
            self._window.active = _WHOLE
        width = list(_WINDOWS.values())[self._window.active or 0]
        first, last = history.span
        start = first if width is None else max(first, last - width)
        rows = history.n_rows if width is None else round(width / (history.dt or 1.0))
        step = step_for(min(rows, history.n_rows), _POINTS)
        behind = history.n_rows - self._drawn_end
        if self._drawn_step != step or ended != self._ended or behind < 0:
            self._drawn_step, self._ended = step, ended
            view = history.view(start, last, _POINTS, to_the_end=ended)
            self._replace(view, history.spread)
        elif behind >= step:
            view = history.since(self._drawn_end, step)
            self._append(view, history.spread, None if width is None else rows, start)
        self._time.update(start=start, end=last if width is None else max(last, first + width))

    def _replace(self, view: View, spread: FloatArray) -> None:
        self._drawn_end = view.end
        self._sources.samples.data = figures.as_data(self._columns, view, spread)
        self._fit()
        self._mark_flags(figures.flag_marks(view))

    def _append(self, view: View, spread: FloatArray, rows: int | None, start: float) -> None:
        """Add to what is drawn; of the samples keep ``rows``, of the flags those from ``start``."""
        self._drawn_end = view.end
        keep = None if rows is None else figures.points_of(view) * (rows // view.step + 2)
        self._sources.samples.stream(figures.as_data(self._columns, view, spread), rollover=keep)
        self._fit()
        drawn, new = self._sources.flags.data, figures.flag_marks(view)
        kept = np.asarray(drawn["time"]) >= start
        if new["time"] or not kept.all():
            self._mark_flags({k: [*np.asarray(drawn[k])[kept].tolist(), *new[k]] for k in new})

    def _mark_flags(self, flags: dict[str, list[Any]]) -> None:
        self._sources.flags.data = {**flags}
        self._draw_lines()

    def _draw_lines(self) -> None:
        flags: Any = self._sources.flags.data
        trigger = self._trigger.trigger
        at = trigger.at if trigger is not None else None
        self._sources.lines.data = {**figures.lines_at(flags, self._mark, at)}

    def _fit(self) -> None:
        limits = self._log.state.limits if self._log is not None else {}
        for plot in self._plots:
            ends = limits.get(quantity_of(str(plot.tags[-1])), ()) if plot.tags else ()
            figures.fit(plot, self._sources, ends, self._overlays)

    def _clear(self) -> None:
        self._drawn_step = 0
        n = len(self._columns)
        self._replace(nothing(n), np.zeros(n))

    def _make_figures(self, columns: tuple[str, ...]) -> None:
        self._columns, self._plots = columns, []
        names = [quantity_of(group[-1]) for group in groups_of(columns)]
        names += [figures.FLAGS] * (figures.FLAGS in columns)
        self._clear()
        table = figures.make_value_table(self._values, len(columns) + 1)
        self._side.children = [table, self._help]
        channels = [group[-1] for group in groups_of(columns)]
        self._trigger.offer(channels)
        self._channels.labels, everything = names, list(range(len(names)))
        if self._channels.active == everything:
            self._lay_out()
        self._channels.active = everything  # lays out where it changes

    @property
    def _chosen(self) -> list[str]:
        """Quantities that are to be seen."""
        return [self._channels.labels[k] for k in self._channels.active]

    def _lay_out(self) -> None:
        """The figures of the view and of the channels that are chosen."""
        view, self._plots = VIEWS[self._view.active or 0], []
        if not self._columns:
            return
        self._make_overlays()
        self._help.visible = view == TIME
        if view != TIME:
            others = [run.planes for run in self._overlays]
            layout = self._planes.layout(view, self._columns, self._chosen, others)
            self._figures.children = [layout]
            if self._log is not None:
                self._draw_plane(self._log)
            return
        limits = self._log.state.limits if self._log is not None else {}
        parts = self._columns, self._sources, self._time, self._chosen, limits
        grid, self._plots = figures.make_figures(*parts)
        figures.lay_behind(self._plots, self._overlays)
        figures.show_level(self._plots, self._trigger.trigger)
        for plot in self._plots:
            plot.on_event(RangesUpdate, self._zoom)
            plot.on_event(Reset, lambda event: self._follow())
            plot.on_event(MouseMove, self._point)
            plot.on_event(MouseLeave, self._point)
            plot.on_event(Tap, lambda event: self._set_mark(event.x))
            plot.on_event(DoubleTap, lambda event: self._set_mark(None))
        self._figures.children = [grid]
        self._fit()

    def _draw_plane(self, log: FollowedLog) -> None:
        """Draw what is not over time, of the stretch of time that is shown."""
        view, history = VIEWS[self._view.active or 0], log.history
        if view == TIME or history is None or not history.n_rows:
            return
        rows = history.rows(*self._shown, self._planes.most)
        self._planes.draw(view, self._columns, self._chosen, rows, history.dt)
        for run in self._overlays:
            earlier = run.log.history
            if earlier is not None and earlier.n_rows:
                rows = earlier.rows(*self._shown, self._planes.most)
                parts = view, run.log.tail.columns, self._chosen, rows, earlier.dt
                self._planes.draw(*parts, run.planes, self._columns)

    def _lay_behind(self) -> None:
        if VIEWS[self._view.active or 0] != TIME:
            self._lay_out()
            return
        self._make_overlays()
        figures.lay_behind(self._plots, self._overlays)

    def _make_overlays(self) -> None:
        """Read the runs that are chosen to lie behind the one that is shown."""
        logs = [self._watch.logs[name] for name in self._behind.value if name in self._watch.logs]
        columns = tuple(name for group in groups_of(self._columns) for name in group)
        before = {(run.log.path, run.color, run.columns): run for run in self._overlays}
        keys = [(log, color, columns) for log, color in zip(logs, OTHERS, strict=False)]
        self._overlays = [before.get(key) or EarlierRun(*key) for key in keys]

    def _middle(self, channel: str) -> float:
        """Between the lowest and the highest value of a channel so far; NaN without any."""
        history = self._log.history if self._log is not None else None
        if history is None or channel not in self._columns:
            return math.nan
        return float(history.middle[self._columns.index(channel)])

    def _wait_for_trigger(self, before: bool) -> None:
        """Follow another trigger, or none again; before: whether there was one."""
        if not before and list(_WINDOWS.values())[self._window.active or 0] is None:
            self._window.active = _TRIGGERED
        self._follow()
        figures.show_level(self._plots, self._trigger.trigger)

    def _stop_run(self) -> None:
        """End the run as Ctrl-C does."""
        process = self._log.state.process if self._log is not None else None
        if process is not None and process.interrupt():
            self._stop.label = _STOPPING

    def _show_stop(self) -> None:
        """Offer to stop a run that goes on in a process of this computer."""
        state = self._log.state if self._log is not None else None
        process = state.process if state is not None and state.running else None
        can_stop = process is not None and process.is_alive()
        if self._stop.visible != can_stop:
            self._stop.update(visible=can_stop, label=_STOP)

    def _show_head(self) -> None:
        self._show_stop()
        newer = self._log is not self._watch.followed
        notes = [
            f'<span style="color:{run.color}">&#9632;</span> behind it: {escape(run.text)}'
            for run in self._overlays
        ]
        if self._trigger.trigger is not None:
            notes.append(f"trigger: {escape(self._trigger.trigger.text())}")
        head = heading(self._log, self._watch.root, newer, notes)
        shown = self._log.path if self._log is not None else None
        others: list[Any] = [name for name, log in self._watch.logs.items() if log != shown]
        if others != self._behind.options:
            self._behind.options = others
        if head != self._head.text:
            self._head.text = head

    def _show_values(self) -> None:
        history = self._log.history if self._log else None
        if history is None or not history.n_rows:
            return
        values = history.at(history.span[1] if self._cursor is None else self._cursor)
        marked = None if self._mark is None else history.at(self._mark)
        if values is None:
            return
        self._values.data = {**readout(self._columns, values, marked, self._cursor is not None)}

    def _follow(self) -> None:
        """Show the end of the run as it grows, or all of it."""
        self._live, self._zoomed_to = True, None
        self._drawn_step = 0
        if self._trigger.trigger is not None:
            self._trigger.trigger.forget()
        self._button.update(label="Pause", button_type="primary")

    def _hold(self) -> None:
        """Stay with what is drawn."""
        self._live = False
        self._button.update(label="Live", button_type="warning")

    def _zoom(self, event: Any) -> None:
        """Stay with this stretch of time, in as much detail as the page has room for."""
        self._time.update(start=event.x0, end=event.x1)
        self._zoomed_to = float(event.x0), float(event.x1)
        self._hold()

    def _point(self, event: Any) -> None:
        self._cursor = None if isinstance(event, MouseLeave) else event.x

    def _set_mark(self, at: float | None) -> None:
        self._mark = at
        self._draw_lines()
