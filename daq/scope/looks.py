"""What is drawn of a log's columns: which share a figure, their colors and names."""

from collections.abc import Sequence

from daq.hal import Flag

# Okabe & Ito's palette: told apart with any colour vision.
BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
PURPLE, GREY = "#CC79A7", "#666666"
OTHERS = (PURPLE, GREEN, "#56B4E9", RED)  # of runs behind the one that is shown
FLAG_COLORS = {
    Flag.CLAMPED: ORANGE, Flag.HELD: BLUE, Flag.LOST: RED, Flag.INTERLOCK: RED,
    Flag.UNDERFLOW: RED, Flag.SATURATED: PURPLE, Flag.DOUBTFUL: PURPLE,
    Flag.LAW: GREEN,
}  # fmt: skip
_UNDRAWN = ("t", "tick", "flags")  # columns without a curve


def groups_of(columns: Sequence[str]) -> list[list[str]]:
    """Columns that share a figure: a command asked and applied, a quantity and its reference."""
    groups: dict[str, list[str]] = {}
    for name in columns:
        if name not in _UNDRAWN:
            group = groups.setdefault(quantity_of(name), [])
            group.insert(0 if is_wanted(name) else len(group), name)
    return list(groups.values())


def is_wanted(column: str) -> bool:
    """Whether a column was asked for, and is drawn behind what came of it."""
    return column.startswith("cmd_") or column.endswith("_ref")


def quantity_of(name: str) -> str:
    """What a column is of: the same for what was asked, what was applied and what followed."""
    return name.removeprefix("cmd_").removeprefix("applied_").removesuffix("_ref")


def color_of(column: str) -> str:
    """Color of a column's curve; none of one that has no curve."""
    if column in _UNDRAWN:
        return "transparent"
    return ORANGE if is_wanted(column) else BLUE


def flag_name(flag: Flag) -> str:
    """A flag's name for people."""
    return str(flag.name).lower()
