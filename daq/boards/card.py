"""What a maker's card does by itself, and the settings that all of them have."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Seconds
from daq.errors import ConfigError, DeviceError
from daq.hal import CHANNELS, FloatArray, Mode

ZERO: FloatArray = np.zeros(len(CHANNELS))  # V, of both outputs
ZERO.flags.writeable = False


WATCHDOG_CURE = (
    "see docs/boards.md for what the card may ask for; or write 'watchdog: null' under options and "
    "have a switch in the amplifiers' supply, for nothing then zeroes them when this program dies"
)


NO_PHASE = (
    "it is not measured how many samples outputs that the card times come behind its inputs, and "
    "open loops are refused until it is"
)
PHASE_CURE = (
    "measure it with 'rig doctor --rig FILE --loopback' and write it into the rig's file, or write "
    "'playback: host'"
)


class CardOptions(Section):
    """Settings of every card."""

    playback: Literal["board", "host"] = Field(
        "board",
        description="who times the outputs of an open loop: the card's clock, or this computer, "
        "a command right after each sample",
    )
    phase: int | None = Field(
        None,
        ge=-8,
        le=8,
        description="samples by which outputs that the card times come behind its inputs, as "
        "'rig doctor --rig FILE --loopback' measures; without it the card times none",
    )
    watchdog: Seconds | None = Field(
        0.1,
        ge=0.01,
        le=10.0,
        description="the card zeroes its outputs when it hears nothing for so long; null: it has "
        "no watchdog, and nothing does",
    )
    buffer: int = Field(
        8192, ge=256, le=1_000_000, description="samples that the card keeps, either way"
    )


def require_phase(options: object, mode: Mode, file: str | None = None) -> None:
    """Raise ConfigError where a card is to time an open loop, and it is not known when."""
    if not isinstance(options, CardOptions) or mode is Mode.CLOSED_LOOP:
        return
    if options.playback == "board" and options.phase is None:
        raise ConfigError(NO_PHASE, cure=PHASE_CURE, file=file, key="options.phase")


@dataclass(frozen=True)
class CardFacts:
    """What an open card is.

    max_rate [Hz]; volts: (low, high) of inputs and outputs; step_out: of the outputs [V].
    """

    name: str
    max_rate: float
    volts: tuple[float, float]
    step_out: float


class Reading(NamedTuple):
    """Samples that the card's clock has latched, n >= 1 rows.

    analog: (n, 3) [V] in ``ANALOG_INPUTS`` order. counts: (n,), whole, of a counter that may run
    over. rates: (n,) [1/s], None where the card estimates none. lost: samples missing before them.
    """

    analog: FloatArray
    counts: npt.NDArray[np.int64]
    rates: FloatArray | None = None
    lost: int = 0


class Card(Protocol):
    """A card between its maker's library and ``CardDevice``.

    Every method but ``stop`` and ``close`` raises DeviceError where the library reports an error;
    those two go through all their steps first.
    """

    def open(self) -> CardFacts:
        """Connect, outputs zero. Raises ConfigError where the maker's library is missing."""

    def start(self, sample_rate: float, played: FloatArray | None) -> None:
        """Sample by the card's clock at ``sample_rate`` [Hz], guarded by the watchdog.

        played: volts (n, 2), the first that the same clock puts out; None where ``write`` does it.
        """

    def read(self, n: int) -> Reading:
        """The next n samples; blocks until they are there."""

    def play(self, volts: FloatArray) -> None:
        """More volts (n, 2) behind those played."""

    def write(self, volts: FloatArray) -> None:
        """Put out volts (2,) now."""

    def feed(self) -> None:
        """Tell the watchdog that this program lives; DeviceError where it had expired."""

    def zero(self) -> None:
        """Play no more, and put out zeros now."""

    def stop(self) -> None:
        """End sampling and watchdog, outputs zero."""

    def close(self) -> None:
        """Disconnect, outputs zero; nothing where it is not open."""


def all_steps(steps: Iterable[Callable[[], None]]) -> None:
    """Take every step, whatever those before raise; then raise the first DeviceError."""
    failures = []
    for step in steps:
        try:
            step()
        except DeviceError as error:
            failures.append(error)
    if failures:
        raise failures[0]
