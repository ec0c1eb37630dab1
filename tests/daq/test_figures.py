"""Figures: every axis says what it shows and in which unit, nothing is cut, files are of a kind."""

import datetime
import itertools
import re
import xml.etree.ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest

from daq.figures import style
from daq.figures.bode import bode
from daq.figures.findings import draw, plot
from daq.figures.history import Overlay, Trend, history
from daq.figures.parameters import convergence, correlation, intervals, ranges, ratios
from daq.figures.responses import responses
from daq.figures.signals import Panel, closer_sentence, signals, spectra
from daq.findings import Axis, Chart, Heatmap, Series

TIME = np.linspace(0.0, 1.0, 400)
WAVE = np.sin(20.0 * TIME)
FREQUENCY = np.linspace(1.0, 100.0, 80)
LAG = 1.0 / (1.0 + 0.1j * FREQUENCY)
# Names as users give them.
NASTY = "gain_$x<&%_of_the_outer_loop"


def charts():
    series = tuple(Series(f"brake {b} V", TIME, b * WAVE, 0.1 + 0.0 * TIME) for b in (1, 2, 3))
    chart = Chart("c", "Torque over speed " * 6, Axis("speed", "rad/s"), Axis("torque", "N*m"),
                  (*series, Series("fitted", TIME, WAVE)))  # fmt: skip
    plane = Heatmap("h", "Z-width", Axis("damping", "N*m*s/rad"), Axis("stiffness", "N*m/rad"),
                    Axis("energy", "J"), np.arange(4.0), np.arange(3.0), np.ones((3, 4)),
                    (Series("bound", np.arange(4.0), np.arange(4.0)),))  # fmt: skip
    words = "brake held at 0.1234 V while the handle is free and nobody touches it"
    crowd = Chart("m", "Many", Axis("speed", "rad/s"), Axis("torque", "N*m"), tuple(
        Series(f"{words} {k}" if k < 2 else f"brake at {k} V and more", TIME, 1e-7 * k * WAVE)
        for k in range(13)))  # fmt: skip
    return chart, plane, crowd


DENSE_TIME = np.arange(3200) / 800.0


def dense(amplitude=1.0):
    """A fast output and one that is noise, over 4 s."""
    rng = np.random.default_rng(0)
    fast, still = amplitude * np.sin(200.0 * DENSE_TIME), rng.normal(size=3200)
    measured = fast + 0.01 * rng.normal(size=3200)
    note = "fit: identified 99.1 %, linear OE −12.3 %"
    return [
        Panel("current", "A", {"measured": measured, "identified": fast, "linear OE": 2.0 * fast},
              note=note),
        Panel("speed", "rad/s", {"measured": still, "identified": 0.0 * still, "linear OE": still},
              note=note),
    ]  # fmt: skip


def drawn():
    lost = np.where(TIME > 0.9, np.nan, WAVE)
    loop = {"angle": TIME, "speed": WAVE, "torque": np.cos(20.0 * TIME)}
    over, torque = {"angle": "rad", "speed": "rad/s"}, Axis("torque", "N*m")
    places = np.array([[0.5, 0.47, 0.54], [0.25, np.nan, np.nan]])
    ends = np.array([[2.0, 1.5, 2.9], [-1.0, -2.0, 0.0]])
    chart, plane, crowd = charts()
    return {
        "signals": signals(TIME, [
            Panel("voltage_motor", "V", {"asked": WAVE, "applied": WAVE}, steps=True),
            Panel(NASTY, "rad/s", {"": lost}),
        ]),
        "responses": responses(TIME, [
            Panel("omega", "rad/s", {"measured": lost, "identified": WAVE, "ARMAX": 1e9 * WAVE},
                  note="fit 9 %"),
            Panel(NASTY, "1", {"measured": WAVE, "identified": WAVE}),
        ]),
        "dense": responses(DENSE_TIME, dense()),
        "dense signals": signals(DENSE_TIME, dense()),
        "convergence": convergence(np.array([0.5, 0.2, 0.11]), 300, 0.2),
        "ranges": ranges(["K_m", NASTY], places, ["", "only together"]),
        "intervals": intervals(["A alpha0", "k"], ends),
        "correlation": correlation(["K_m", NASTY], np.array([[1.0, -0.9], [-0.9, 1.0]])),
        "spectra": spectra(FREQUENCY, {"torque": np.abs(LAG) ** 2}, {"torque": "N*m"}),
        "bode": bode(FREQUENCY, LAG, np.abs(LAG), 0.1 * np.abs(LAG),
                     np.abs(LAG) > 0.1, LAG, FREQUENCY,
                     {"linear, ω = 0": LAG, "linear, ω = 4.12 rad/s": 1.1 * LAG},
                     ("rad/s", "V")),
        "loops": plot(
            over, torque, {"brake 0.1 A": loop, "brake 0.2 A": loop},
            bands={"brake 0.1 A": (loop["torque"] - 0.1, loop["torque"] + 0.1)},
            beyond={"brake 0.2 A": loop["speed"] > 0.5},
        ),
        "points": plot(over, torque, {"brake 0.1 A": loop}, points=True),
        "ratios": ratios(["lag", NASTY * 4, "ARX"],
                         np.array([[1.0, 1.0, 1.0], [1.1, 0.9, 1.3], [80.0, 52.0, 136.0]])),
        "chart": draw(chart),
        "plane": draw(plane),
        "crowd": draw(crowd),
    }  # fmt: skip


@pytest.fixture(scope="module")
def figures():
    before = dict(mpl.rcParams)
    made = drawn()
    assert dict(mpl.rcParams) == before
    return made


NAMES = [
    "signals", "responses", "dense", "dense signals", "convergence", "ranges", "intervals",
    "correlation", "spectra", "bode", "loops", "points", "chart", "plane", "crowd", "ratios",
]  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_has_a_name_and_a_unit(figures, name):
    for axes in figures[name].axes:
        ticks = [text.get_text() for text in axes.get_yticklabels()]
        words = any(re.search("[A-Za-z]{2}|\\$", text) for text in ticks)  # rows with names
        shares = axes.yaxis.get_tick_params().get("labelleft", True) is False
        if not words and not shares and name != "ratios":  # whose rows are named inside
            assert re.search(r"\[.+\]", axes.get_ylabel()), axes.get_ylabel()
        below = axes.xaxis.get_tick_params().get("labelbottom", True)
        shown = any(text.get_text() for text in axes.get_xticklabels())
        if below and shown and name != "correlation" and axes.get_label() != "<colorbar>":
            assert re.search(r"\[.+\]", axes.get_xlabel()), axes.get_xlabel()


@pytest.mark.parametrize("name", NAMES)
def test_a_column_wide_and_nothing_is_cut(figures, name):
    figure = figures[name]
    assert figure.get_size_inches()[0] == pytest.approx(3.5)
    figure.draw_without_rendering()
    needed = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert needed.x0 > -0.01 and needed.y0 > -0.01
    assert needed.x1 < width + 0.01 and needed.y1 < height + 0.01


@pytest.mark.parametrize("name", NAMES)
def test_labels_of_axes_do_not_overlap(figures, name):
    figure = figures[name]
    figure.draw_without_rendering()
    boxes = [
        label.get_window_extent()
        for axes in figure.axes
        for label in (axes.xaxis.label, axes.yaxis.label)
        if label.get_text()
    ]
    for k, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[k + 1 :])


@pytest.mark.parametrize("name", ["bode", "loops", "chart", "crowd"])
def test_legends_touch_neither_title_nor_panels(figures, name):
    figure = figures[name]
    figure.draw_without_rendering()
    (key,) = figure.legends
    box = key.get_window_extent()
    others = [axes.get_window_extent() for axes in figure.axes]
    others += [text.get_window_extent() for text in figure.texts]
    others += [axes.yaxis.get_offset_text().get_window_extent() for axes in figure.axes]
    assert not any(box.overlaps(other) for other in others)


def test_a_legend_names_only_what_is_drawn():
    def legend(ends):
        figure = ranges(["gain"], np.array([[0.5, *ends]]), [""])
        return {text.get_text() for text in figure.legends[0].get_texts()}

    assert legend((0.4, 0.6)) == {"range", "95 % interval", "value"}
    assert legend((np.nan, np.nan)) == {"range", "no interval"}


def test_files_are_of_their_kind_and_the_same_every_time(figures):
    figure = figures["bode"]
    assert style.render(figure, "png").startswith(b"\x89PNG")
    assert style.render(figure, "pdf").startswith(b"%PDF")
    vector = style.render(figure, "svg")
    assert ET.fromstring(vector).tag.endswith("svg")
    assert vector == style.render(figure, "svg")


def test_a_long_record_is_thinned_without_losing_its_extremes():
    rng = np.random.default_rng(0)
    values = rng.normal(size=200_000)
    values[[777, 123_456]] = 50.0, -60.0
    values[1000:1400] = np.nan
    x, y = style.thinned(np.arange(200_000.0), values)
    assert len(x) < 10_000
    assert np.all(np.diff(x) > 0)
    assert (np.nanmax(y), np.nanmin(y)) == (50.0, -60.0)
    assert (x[0], x[-1]) == (0.0, 199_999.0)


def test_what_is_measured_seldom_or_unevenly_is_a_line_and_what_is_missing_a_gap():
    place = np.arange(300)
    measured = (place % 3 == 0) & (place % 7 != 0) & ((place < 100) | (place > 200))
    x, y = style.thinned(0.01 * place, np.where(measured, 1.0, np.nan))
    assert np.count_nonzero(~np.isnan(y)) == np.count_nonzero(measured)
    (gap,) = np.flatnonzero(np.isnan(y))
    assert x[gap - 1] < 1.0 < 2.0 < x[gap + 1]


def test_a_model_that_runs_away_does_not_flatten_what_was_measured(figures):
    response, residual = figures["responses"].axes[:2]
    assert response.get_ylim()[1] < 2.0
    assert residual.get_ylim()[1] < 2.0
    marks = {line.get_marker() for panel in (response, residual) for line in panel.lines}
    assert marks & {"^", "v"}  # where it is beyond the frame


def test_a_small_residual_and_a_small_signal_are_in_multiples_of_their_units():
    lines = {"measured": 3e-5 * WAVE, "identified": 2.8e-5 * WAVE}
    figure = responses(TIME, [Panel("gap", "m", lines), Panel("rate", "1/s", lines)])
    labels = [panel.get_ylabel().split("\n")[-1].split()[-1] for panel in figure.axes]
    assert labels[:2] == ["[µm]", "[µm]"]
    assert "10⁻⁶" in figure.axes[2].get_ylabel()
    figure.canvas.draw()
    assert not any(panel.yaxis.get_offset_text().get_text() for panel in figure.axes)
    residual = figure.axes[1].lines[0].get_ydata()
    assert np.nanmax(np.abs(residual)) == pytest.approx(2.0 * np.abs(WAVE).max(), rel=0.1)


def test_what_is_too_dense_to_be_read_is_shown_closer_where_it_moves_most():
    amplitude = np.where((DENSE_TIME > 2.0) & (DENSE_TIME < 2.5), 1.0, 0.3)
    axes = responses(DENSE_TIME, dense(amplitude)).axes
    whole, closer = axes[:4], axes[4:]
    for there, here in zip(whole, closer, strict=True):
        low, high = here.get_xlim()
        assert 2.0 < low < high < 2.5 and here.get_ylim() == there.get_ylim()
        assert there.get_xlim()[0] < 0.0 < 4.0 < there.get_xlim()[1]
    shown = closer[0].lines[0].get_xdata()
    swings = 200.0 / np.pi * np.ptp(shown)
    assert 10 < swings < 30 and np.diff(shown) == pytest.approx(1.25e-3)


def test_what_can_be_read_and_what_is_noise_have_no_closer_look():
    slow = Panel("omega", "rad/s", {"measured": WAVE, "identified": WAVE})
    assert len(responses(TIME, [slow]).axes) == 2
    assert len(responses(DENSE_TIME, dense()[1:]).axes) == 2
    assert closer_sentence([slow]) == "" and "closer" in closer_sentence(dense())


@pytest.mark.parametrize("n", [4, 12, 19, 40])
def test_names_of_correlated_parameters_do_not_overlap(n):
    names = [f"omega_d{k}" for k in range(n)]
    figure = correlation(names, np.eye(n))
    figure.draw_without_rendering()
    panel = figure.axes[0]
    for labels in (panel.get_xticklabels(), panel.get_yticklabels()):
        boxes = [label.get_window_extent() for label in labels]
        assert len(boxes) == n
        assert not any(a.overlaps(b) for a, b in itertools.pairwise(boxes))


def test_phases_go_on_beyond_a_turn_and_what_may_be_noise_is_left_out():
    frequency = np.linspace(1.0, 40.0, 79)
    late = np.exp(-2j * np.pi * frequency * 0.05) / frequency
    seen = (frequency <= 15.0) | (frequency >= 20.0)
    band = np.geomspace(1.0, 40.0, 400)  # where a linear model is known, it is drawn
    linear = {"linear": np.exp(-2j * np.pi * band * 0.05) / band}
    parts = late, 0.9 * seen, 0.1 * np.abs(late), seen, late, band, linear
    figure = bode(frequency, *parts, ("rad", "V"))
    estimated, line = figure.axes[1].lines[-2:]
    np.testing.assert_array_equal(line.get_xdata(), band)
    np.testing.assert_allclose(line.get_ydata(), -360.0 * 0.05 * band, atol=1e-9)
    near = np.where(seen, -360.0 * 0.05 * frequency, np.nan)
    np.testing.assert_allclose(estimated.get_ydata(), near, atol=1e-9)
    for panel in figure.axes[:2]:
        points = next(line for line in panel.lines if line.get_marker() == ".")
        np.testing.assert_array_equal(points.get_xdata(), frequency[seen])
    assert figure.axes[1].get_ylim()[0] < -720.0


def test_a_parameter_of_one_evening_has_short_numbers_and_no_years_beside_it():
    evening = datetime.datetime(2026, 1, 2, 18, tzinfo=datetime.UTC)
    values = np.array([[1.05e-4, 1.0e-4, 1.1e-4]])
    overlay = Overlay("omega", "rad/s", {"run": (TIME, WAVE)})
    figure = history([overlay], [Trend("J_m", "kg*m^2", [evening], values)])
    figure.canvas.draw()
    panel = figure.axes[-1]
    labels = {label.get_text() for label in panel.get_yticklabels()}
    assert "10⁻⁴" in labels and not any("e" in label or "0·" in label for label in labels)
    assert np.ptp(panel.get_xlim()) < 1.0  # d
