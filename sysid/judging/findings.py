"""What score tests find: what a model lacks, how sure that is, what it moves, and in what words."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from sysid.judging.phrases import either, sized
from sysid.judging.suspects import Kind
from sysid.problem.model import ProcessModel
from sysid.problem.terms import AddedTerm
from sysid.uncertainty import Estimate

# Standard deviations by which a finding moves a parameter noticeably: an interval reaches 1.96. And
# share of the residuals that it explains, from where it counts whatever it moves.
MOVED, _LARGE = 1.5, 0.25
_WIDER = 1.25  # times as wide, from where intervals without the finding are too sure
_NEARLY_ALL = 0.9  # of what is left, beside which a line's guess leaves what looks like anything
_TURNED = -1.3  # change of a gain that is 1, below which it is its sign that is wrong


@dataclass(frozen=True)
class Move:
    """By how much a finding would move a quantity, in its unit and in standard deviations."""

    quantity: Estimate
    change: float
    deviations: float


def is_of_parameters(quantity: Estimate, model: ProcessModel) -> bool:
    """Whether a quantity is of the model's parameters, and no start of a state."""
    return quantity.combination is not None or quantity.name in model.parameter_names


def moves_of(estimates: Iterable[Estimate], changes: Iterable[float]) -> tuple[Move, ...]:
    """Moves of the estimates that have a deviation, the farthest first."""
    moves = [
        Move(e, c, c / e.deviation) for e, c in zip(estimates, changes, strict=True) if e.deviation
    ]
    return tuple(sorted(moves, key=lambda move: -abs(move.deviations)))


@dataclass(frozen=True)
class Finding:
    """Something that the model lacks: what it is, how sure, and what it would move.

    name, unit: as of its suspect. amplitude: of a channel's fault, in the unit; None of others.
    term: of a function the one that it is most like, with a range to fit it in; rivals: those of
    other shapes that it is like as well, between which fits decide. of_input: whether a channel is
    an input. p_value: by chance, all tests counted. share: of the whitened residuals' squares that
    it explains. moves: the farthest first. wider: how many times as wide the interval is that it
    widens most. alike: channels, of which the same fault would look the same in these data;
    instead: other faults that explain nearly as much. late: of a filter, by how much it is late
    beside its time [s].
    """

    kind: Kind
    name: str
    unit: str
    amplitude: float | None
    p_value: float
    share: float
    moves: tuple[Move, ...]
    term: AddedTerm | None = None
    of_input: bool = False
    wider: float = 1.0
    rivals: tuple[AddedTerm, ...] = ()
    alike: tuple[str, ...] = ()
    instead: tuple["Finding", ...] = ()
    late: float = 0.0

    @property
    def farthest(self) -> float:
        """Standard deviations by which it moves what it moves farthest."""
        return abs(self.moves[0].deviations) if self.moves else 0.0

    @property
    def counts(self) -> bool:
        """Whether it moves a parameter noticeably, widens intervals, or is much of what is left."""
        return self.farthest > MOVED or self.share > _LARGE or self.widens

    @property
    def widens(self) -> bool:
        """Whether an interval without it is too narrow."""
        return self.wider > _WIDER

    @property
    def comes_late(self) -> bool:
        """Whether it is a channel's delay, or what is one of a little."""
        return self.kind in ("delay", "filter", "lag")

    @property
    def is_hidden(self) -> bool:
        """Whether it is motion for which the model has no state."""
        return self.kind in ("follower", "resonance")

    @property
    def explains(self) -> bool:
        """Whether next to nothing is left with a channel's fault taken out."""
        return self.amplitude is not None and self.share > _NEARLY_ALL

    @property
    def turned_round(self) -> bool:
        """Whether a channel has the opposite sign of what the model has."""
        return self.kind == "gain" and (self.amplitude or 0.0) < _TURNED


@dataclass(frozen=True)
class Unseen:
    """What these data would not show, and what the fit would have taken it for.

    moves: the farthest first. cure: a sentence on what would show it.
    """

    text: str
    moves: tuple[Move, ...]
    cure: str

    @property
    def farthest(self) -> float:
        """Standard deviations by which it moves what it moves farthest."""
        return abs(self.moves[0].deviations) if self.moves else 0.0


@dataclass(frozen=True)
class Missing:
    """What a model lacks, the surest first; where that counts for nothing, what may be unseen."""

    findings: tuple[Finding, ...] = ()
    unseen: tuple[Unseen, ...] = ()


_WORDS = {
    "delay": "{name} is logged {time} {late}",
    "mean": "{name} is logged as its mean over the {time} before each sample, as "
    "differences of positions are, or late by half of that",
    "filter": "{name} is logged through a filter of {time}",
    "lag": "{name} acts with a lag of {time}",
    "play": "{name} acts through play (hysteresis) of {amplitude:.3g} {unit}",
    "offset": "{name} is {amplitude:.3g} {unit} off{instead}",
    "drift": "{name} drifts by {amplitude:.3g} {unit} from a record's first sample on{instead}",
    "noise": "{name} is logged with noise of {amplitude:.2g} {unit}, which has not acted",
    "crosstalk": "{name} as well, {amplitude:.2g} {unit} of it (crosstalk)",
    "saturation": "{name} saturates near its largest values",
    "fixed": "{name}, which is fixed, would be {times:.3g} times its value, or the gain of a "
    "channel is wrong that looks the same",
    "feedback": "{name} answers what the outputs err by, as a controller's output does, and these "
    "errors have a memory: the fit has taken part of the answer for the plant's",
    "resonance": "something that swings with {name} at about {time}, as an inertia behind a shaft, "
    "a belt or a coupling that gives: the model has no state for it",
    "follower": "something that follows {name} with a time constant of about {time}, as a body "
    "behind a viscous coupling, or a store of heat: the model has no state for it",
    "exchange": "{name} have changed places in the log",
}
_FAULTS = {"gain": "a wrong gain", "offset": "an offset", "drift": "a drift"}
# What has no single amplitude.
_SHAPES = {
    "rest": "another {name}, as behind a driver that opens between pulses: the model's equations "
    "want a case for that",
    "bend": "a {name} that changes with the {by} of what it multiplies",
    "curve": "a curve between {name} and what is logged of it, as of a sensor that bends",
    "disturbance": "a slow signal in d{name}/dt that nobody measured",
}


def description(finding: Finding) -> str:
    """A finding in a few words, with what looks the same."""
    text = ", or ".join(map(_name_of, (finding, *finding.instead)))
    if not finding.alike:
        return text
    return f"{text}; {_FAULTS[finding.kind]} of {either(finding.alike)} would look the same"


def _name_of(finding: Finding) -> str:
    amplitude, unit = finding.amplitude, "" if finding.unit == "1" else finding.unit
    if finding.kind == "variant":
        return finding.name
    if finding.kind in _SHAPES:
        squared = finding.term is not None and finding.term.shape == "parabola"
        by = "square" if squared else "size"
        return _SHAPES[finding.kind].format(name=finding.name, by=by)
    if finding.term is not None:
        return _term_text(finding.term)
    assert amplitude is not None
    if finding.kind == "change":
        change = f"{100.0 * amplitude:+.{0 if abs(amplitude) >= 0.01 else 2}f} % of its value"
        return f"{finding.name} changes by {change} from a record's first to last sample"
    if finding.kind == "gain":
        as_in = f", as in {unit}" if unit else ""
        times = f"is {1.0 + amplitude:.3g} times what the model has{as_in}"
        opposite = "has the opposite sign of what the model has"
        return f"{finding.name} {opposite if finding.turned_round else times}"
    early = "early, or acts so much later" if finding.of_input else "early, or its inputs so late"
    late = "late" if amplitude > 0.0 else early
    instead = ", or something not measured acts like it" if finding.of_input else ""
    text = _WORDS[finding.kind]
    size = abs(amplitude) if finding.kind == "delay" else amplitude
    beside = f", and {sized(finding.late, 's')} late" if finding.late else ""
    return (
        text.format(
            name=finding.name,
            late=late,
            amplitude=size,
            time=sized(size, finding.unit, 2) if finding.is_hidden else sized(size, "s"),
            times=1.0 + size,
            unit=unit,
            instead=instead,
        )
        .replace("  ", " ")
        .strip()
        + beside
    )


def _term_text(term: AddedTerm) -> str:
    """A term in a few words."""
    equation = f"d{term.equation}/dt"
    if term.shape == "stribeck":
        return (
            f"a term in {term.of} near its zero in {equation}, like friction that is larger near "
            "standstill (Stribeck)"
        )
    if term.shape == "sign" and term.of == term.equation and term.centre == 0.0:
        return f"a term in the sign of {term.of} in {equation}, like dry friction"
    if term.shape == "sine":
        period = sized(2.0 * math.pi * term.scale, term.unit)
        return f"a term in {equation} that repeats with {term.of} (every {period}), like cogging"
    about = f" about {sized(term.centre, term.unit)}" if term.centre else ""
    return f"a term in {term.of} ({term.shape}{about}) in {equation}"
