"""One look for all figures: a column of print (3.5 in), 7 pt, colours told apart by everyone.

Colours are those of Okabe and Ito (jfly.uni-koeln.de/color, 2008), and lines differ in
dash or weight as well, so that figures survive a black-and-white printer.
"""

import io
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cbook import is_math_text
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullLocator,
    StrMethodFormatter,
)

from daq import notation
from daq.errors import ConfigError
from daq.hal import FloatArray

FORMATS = ("svg", "pdf", "png")
PRINTED = ("pdf", "png")  # of figures that stand by themselves
# Dates and versions would make every file another.
_NAMELESS: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": None, "Format": None, "Type": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}

WIDTH = 3.5  # in, one column
LEFT = 0.72  # in, left of the panels
DPI = 300
TICK_LABEL = 6.5  # pt, also of legends

MEASURED = "#4d4d4d"
IDENTIFIED = "#d55e00"
BASELINE = "#0072b2"
ASKED = "#56b4e9"
FAINT = "#bdbdbd"
# For whatever else comes in several: Okabe and Ito's, the darker first.
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
DASHES = ("-", "--", "-.", ":")

_LETTER = 0.058  # in, mean width of a letter of a label
_UPRIGHT_LINES, _SMALLER = 3, 0.8  # of an upright label beyond so many lines
_LONGEST = 18  # letters of a row's name
_POINTS = 72.0  # an inch
_HANDLE = 0.22  # in, what a legend shows beside a label
_BETWEEN = 0.11  # in, between its columns
_ROW, _LINE = 0.14, 0.108  # in, from one of its labels to the next, and from line to line
_SPARE = 0.08  # in, by which a label may stand over its panel
_DECADES = 8  # of an axis, up to which there is room for marks between them
_PLAIN = 30.0  # span of a logarithmic axis below which it needs more marks than the decades

# More points than a column of print can show are drawn as their envelope.
_COLUMNS = 1400

_USUAL = 0.95  # share of the distances between measured samples that are usual
_GAP = 3.0  # times the largest of those, from which on a line is broken

# The default takes a third more time in all, for files a twentieth smaller.
_PNG_LEVEL = 3
_LAYOUT = ("GDEF", "GPOS", "GSUB")  # tables of a font

_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans", "font.size": 7.0, "axes.labelsize": 7.0, "axes.titlesize": 7.0,
    "xtick.labelsize": TICK_LABEL, "ytick.labelsize": TICK_LABEL,
    "legend.fontsize": TICK_LABEL, "legend.frameon": False, "legend.handlelength": 1.6,
    "legend.handletextpad": 0.8, "legend.columnspacing": 1.2,
    "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "axes.axisbelow": True, "grid.color": "#e4e4e4", "grid.linewidth": 0.4,
    "lines.linewidth": 0.9, "lines.solid_joinstyle": "round",
    "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.major.size": 2.5, "ytick.major.size": 2.5,
    # Mathematical text is parsed, at ten times the price of plain text.
    "axes.formatter.use_mathtext": False, "mathtext.fontset": "dejavusans",
    "axes.formatter.limits": (-3, 4), "axes.unicode_minus": True,
    # Outlines look alike everywhere; what they spell is in the caption.
    "svg.fonttype": "path", "svg.hashsalt": "rig",
    # Fonts that journals' checkers take.
    "pdf.fonttype": 42,
}  # fmt: skip

# A drawing function under the shared settings, which are put back behind it.
styled = mpl.rc_context(_SETTINGS)  # type: ignore[arg-type]


def stack(
    heights: Sequence[float],
    gaps: Sequence[float] | float = 0.12,
    *,
    left: float = LEFT,
    right: float = 0.1,
    top: float = 0.28,
    bottom: float = 0.4,
    share_x: bool = True,
) -> tuple[Figure, list[Axes]]:
    """A figure of panels under one another; all lengths in inches.

    gaps: below each panel but the last, or one for all. Places are given rather than found by a
    layout engine, which would draw everything twice.
    """
    between = [gaps] * (len(heights) - 1) if isinstance(gaps, float | int) else list(gaps)
    tall = top + bottom + sum(heights) + sum(between)
    figure = Figure(figsize=(WIDTH, tall), dpi=DPI)
    panels: list[Any] = []
    above = top
    for height, gap in zip(heights, [*between, 0.0], strict=True):
        box = (left / WIDTH, 1 - (above + height) / tall, (WIDTH - left - right) / WIDTH,
               height / tall)  # fmt: skip
        first = panels[0] if panels and share_x else None
        panels.append(figure.add_axes(box, sharex=first))
        above += height + gap
    if share_x:
        for panel in panels[:-1]:
            panel.tick_params(labelbottom=False)
    return figure, panels


def split(panels: Sequence[Axes], share: float, gap: float = 0.14) -> list[Axes]:
    """Give a share of each panel's width to a further one beside it, of the same heights.

    gap: inches between them. The further ones share their horizontal axis.
    """
    beside: list[Axes] = []
    for panel in panels:
        figure, box = panel.get_figure(root=True), panel.get_position()
        assert figure is not None
        width = share * box.width
        panel.set_position((box.x0, box.y0, box.width - width - gap / WIDTH, box.height))
        place = (box.x1 - width, box.y0, width, box.height)
        beside.append(figure.add_axes(place, sharex=beside[0] if beside else None, sharey=panel))
        beside[-1].tick_params(labelleft=False, labelbottom=panel is panels[-1])
    return beside


def name_y(panel: Axes, name: str, unit: str) -> None:
    """Label of a vertical axis, ``name [unit]``, wrapped to the panel's height.

    It stands at the figure's edge, so that those of all panels align. Numbers beside it that go by
    quarters (0.0425) would have a digit more than there is room for.
    """
    locator = panel.yaxis.get_major_locator()
    if isinstance(locator, MaxNLocator):
        locator.set_params(steps=[1, 2, 5, 10])
    figure = panel.get_figure(root=True)
    assert figure is not None
    width, tall = figure.get_size_inches()
    box = panel.get_position()
    room = box.height * tall + _SPARE
    lines, size = _label_lines(name, unit, room / _LETTER), _SETTINGS["axes.labelsize"]
    if len(lines) > _UPRIGHT_LINES:
        # Of another line there is no room beside the numbers, unless all are smaller.
        lines, size = _label_lines(name, unit, room / (_SMALLER * _LETTER)), _SMALLER * size
    panel.set_ylabel("\n".join(lines), va="top", linespacing=1.05, fontsize=size)
    panel.yaxis.set_label_coords((0.03 - box.x0 * width) / (box.width * width), 0.5)


def _label_lines(name: str, unit: str, letters: float) -> list[str]:
    longest = max(int(letters), 6)
    lines = textwrap.wrap(name, longest, break_long_words=False) or [""]
    if len(lines) == 1 and len(lines[0]) + len(unit) < longest:
        return [f"{lines[0]} {unit}"]
    return [*lines, unit]


def logarithmic(axis: Axis, values: FloatArray) -> None:
    """A logarithmic axis of final limits, with plain numbers where powers of ten would not do.

    Powers of ten alone leave an axis of less than a few decades unmarked.
    """
    axis._set_axes_scale("log")  # type: ignore[attr-defined]
    positive = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(positive.min()), float(positive.max())) if len(positive) else (1.0, 10.0)
    if high < _PLAIN * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plain = low >= 1e-3 and high < 1e5
    axis.set_major_formatter(StrMethodFormatter("{x:g}") if plain else FuncFormatter(_power))
    axis.set_minor_locator(NullLocator())
    _mark_digits(axis)


def _mark_digits(axis: Axis) -> None:
    """Marks at 2 to 9 of each decade, in one piece: minor ticks would cost a fifth of a report."""
    panel = axis.axes
    across = axis is panel.xaxis
    low, high = panel.get_xlim() if across else panel.get_ylim()
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)))
    if len(decades) > _DECADES:
        return
    digits = np.outer(10.0**decades, np.arange(2.0, 10.0)).ravel()
    inside = digits[(digits > low) & (digits < high)]
    edge = np.zeros(len(inside))
    panel.plot(
        *((inside, edge) if across else (edge, inside)), ls="", marker=3 if across else 0, ms=1.5,
        mew=0.4, color="black", clip_on=False, scalex=False, scaley=False,
        transform=panel.get_xaxis_transform() if across else panel.get_yaxis_transform(),
    )  # fmt: skip


def _power(value: float, _place: int | None = None) -> str:
    """A power of ten, or a multiple of one."""
    return _typeset(f"{value:.0e}")


def tick(value: float, _place: float | None = None) -> str:
    """A number beside a linear axis, in three digits or as few as it has."""
    return _typeset(notation.shortest(float(f"{value:.3g}")))


def _typeset(text: str) -> str:
    """A printed number (``5.4e-4``) as mathematics has it."""
    mantissa, _, power = text.replace("-", "−", text.startswith("-")).partition("e")
    if not power:
        return mantissa
    times = "" if mantissa == "1" else f"{mantissa}·"
    return f"{times}10{notation.raised(str(int(power)))}"


def row_names(names: Sequence[str]) -> tuple[list[str], float]:
    """Parameters' names as labels of rows, and the room in inches that they take."""
    shown = [name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…" for name in names]
    longest = max((len(name) for name in shown), default=0)
    return [notation.label(name) for name in shown], max(_LETTER * longest + 0.16, 0.5)


def legend_room(labels: Sequence[str], left: float = LEFT) -> float:
    """Inches that a legend takes above the panels, whose left end is so far from the edge."""
    return _arranged(labels, left)[2]


def legend(
    figure: Figure, panel: Axes, left: float = LEFT, above: float = 0.0, marks: float = 1.0
) -> None:
    """What the lines of a panel mean, at the top of the figure.

    above: inches kept free there. marks: how much larger its marks are than the panel's.
    """
    handles, labels = panel.get_legend_handles_labels()
    width, tall = figure.get_size_inches()
    shown, columns, _ = _arranged(labels, left)
    drawn = figure.legend(
        handles, shown, loc="upper left", ncols=columns, markerscale=marks,
        bbox_to_anchor=((left - _SPARE) / float(width), 1 - (0.02 + above) / float(tall)),
        borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    for handle in drawn.legend_handles:
        if marks != 1.0 and isinstance(handle, Line2D):
            handle.set_markeredgewidth(marks * handle.get_markeredgewidth())


def _arranged(labels: Sequence[str], left: float) -> tuple[list[str], int, float]:
    """Labels as a legend shows them, its columns, and its height with a margin [in]."""
    room = WIDTH - left + 0.5 * _SPARE
    for columns in range(len(labels), 1, -1):
        # Column by column, as matplotlib fills them.
        filled = np.array_split(np.array(labels), columns)
        taken = sum(_HANDLE + max(text_width(label) for label in column) for column in filled)
        if taken + (columns - 1) * _BETWEEN < room:
            return list(labels), columns, 0.1 + _ROW * len(filled[0])
    shown = [_folded(label, room - _HANDLE) for label in labels]
    lines = sum(label.count("\n") for label in shown)
    return shown, 1, 0.1 + _ROW * len(labels) + _LINE * lines


def _folded(label: str, room: float) -> str:
    """A label on as many lines as it takes to be no wider than so many inches."""
    for letters in range(len(label), 8, -2):
        lines = textwrap.wrap(label, letters)
        if all(text_width(line) <= room for line in lines):
            return "\n".join(lines)
    return "\n".join(textwrap.wrap(label, 8))


def text_width(text: str) -> float:
    """Inches that the text of a legend or of a tick takes."""
    font = FontProperties(size=_SETTINGS["legend.fontsize"])
    is_math = bool(is_math_text(text))
    shown = text if is_math else text.replace(r"\$", "$")
    return float(text_to_path.get_text_width_height_descent(shown, font, is_math)[0]) / _POINTS


def thinned(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A line that looks the same in print with no more points than can be told apart.

    Of long records the lowest and highest point of each column are kept, in their order. NaN
    breaks it only where more is missing than is usual for it: a signal sampled unevenly, or more
    seldom than others, is a line as well.
    """
    x, y = _joined(x, y)
    n = len(x)
    if n <= 4 * _COLUMNS:
        return x, y
    size = int(np.ceil(n / _COLUMNS))
    whole = n // size
    blocks = y[: whole * size].reshape(whole, size)
    lows = np.where(np.isnan(blocks), np.inf, blocks).argmin(axis=1)
    highs = np.where(np.isnan(blocks), -np.inf, blocks).argmax(axis=1)
    starts = np.arange(whole) * size
    kept = np.unique(np.concatenate([starts + lows, starts + highs, [0, n - 1]]))
    return x[kept], y[kept]


def _joined(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A line without the NaN between points that are as far apart as most are."""
    there = np.flatnonzero(~np.isnan(y))
    if len(there) in (0, len(y)):
        return x, y
    distances = np.diff(x[there])
    usual = np.quantile(distances, _USUAL, method="lower") if len(distances) else 0.0
    missing = there[:-1][distances > _GAP * usual] + 1
    kept = np.union1d(there, missing)
    return x[kept], y[kept]


def format_of(path: Path) -> str:
    """The format that a file's name asks for; ConfigError for one that there is not."""
    kind = path.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise ConfigError(
            f"figures are written as {', '.join(FORMATS)}",
            cure=f"for example {path.with_suffix('.png')}",
            file=path,
        )
    return kind


@contextmanager
def _light_fonts() -> Iterator[None]:
    """Have fonts embedded without the tables by which text is laid out, as it is already.

    To cut these down to a figure's few letters takes longer than all else in a PDF.
    """
    from fontTools.subset import Options  # type: ignore[import-untyped]

    dropped = Options._drop_tables_default
    Options._drop_tables_default = [*dropped, *_LAYOUT]
    try:
        yield
    finally:
        Options._drop_tables_default = dropped


@styled
def render(figure: Figure, kind: str) -> bytes:
    """A figure as a file of one of ``FORMATS``; the same figure gives the same bytes."""
    # SVG goes as text, which is encoded once rather than piece by piece.
    target = io.StringIO() if kind == "svg" else io.BytesIO()
    packed: dict[str, Any] = {}
    if kind == "png":
        packed["pil_kwargs"] = {"compress_level": _PNG_LEVEL}
    with _light_fonts() if kind == "pdf" else nullcontext():
        figure.savefig(target, format=kind, dpi=DPI, metadata=_NAMELESS[kind], **packed)
    content = target.getvalue()
    return content.encode() if isinstance(content, str) else content


def render_each(figure: Figure, kinds: Sequence[str]) -> dict[str, bytes]:
    """A figure as files of several formats, by format."""
    return {kind: render(figure, kind) for kind in kinds}
