"""Cards of Quanser by the HIL library of their SDK: QPID, QPIDe, Q8-USB and the like."""

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from daq.boards.card import WATCHDOG_CURE, CardFacts, CardOptions, Reading, all_steps
from daq.boards.device import CardDevice
from daq.config.base import Section
from daq.config.units import Volts
from daq.errors import ConfigError, DeviceError
from daq.hal import ANALOG_INPUTS, CHANNELS, FloatArray

_COUNTS_PER_SECOND = 14_000  # of the library's other inputs: those of encoder 0
_BITS = 16  # of the outputs
_MOST_RATE = 10_000.0  # Hz, up to which Python has been seen to keep up
_Channels = npt.NDArray[np.uint32]


class QuanserInputs(Section):
    """Analog inputs by number."""

    current_motor: int = Field(0, ge=0, description="of the motor's current sense")
    current_brake: int = Field(1, ge=0, description="of the brake's current sense")
    torque: int = Field(2, ge=0, description="of the torque bridge")


class QuanserOutputs(Section):
    """Analog outputs by number."""

    motor: int = Field(0, ge=0, description="to the motor's amplifier")
    brake: int = Field(1, ge=0, description="to the brake's amplifier")


class QuanserOptions(CardOptions):
    """Options of the Quanser backend."""

    card: str = Field(
        "qpid", min_length=1, description="the card's name in the SDK: qpid, qpid_e, q8_usb, ..."
    )
    identifier: str = Field("0", description="which of several such cards, from 0")
    inputs: QuanserInputs = Field(QuanserInputs(), description="analog inputs")
    outputs: QuanserOutputs = Field(QuanserOutputs(), description="analog outputs")
    encoder: int = Field(0, ge=0, description="encoder input of the shaft")
    velocity: bool = Field(
        True, description="the card times the encoder's edges; false: a rate of the counts is used"
    )
    analog_outputs: int = Field(
        8, ge=2, le=64, description="that the card has: the watchdog zeroes all of them"
    )
    range: Volts = Field(10.0, gt=0.0, le=10.0, description="of inputs and outputs, either way")


class QuanserCard:
    """A card of Quanser (see ``daq.boards.card.Card`` for the methods)."""

    def __init__(self, options: QuanserOptions) -> None:
        self._options = options
        self._inputs = _numbers(*(getattr(options.inputs, name) for name in ANALOG_INPUTS))
        self._outputs = _numbers(*(getattr(options.outputs, name) for name in CHANNELS))
        self._encoder = _numbers(options.encoder)
        self._velocity = _numbers(_COUNTS_PER_SECOND + options.encoder)
        self._sdk: Any = None
        self._card: Any = None
        self._reader: Any = None
        self._writer: Any = None
        self._guarded = False
        self._overflows = 0

    def open(self) -> CardFacts:
        """Connect; outputs and encoder zero, what an earlier watchdog left behind cleared."""
        self._sdk = sdk = _sdk()
        options = self._options
        card = sdk.HIL()
        with self._words(f"opening card {options.card!r}, identifier {options.identifier!r}"):
            card.open(options.card, options.identifier)
        self._card = card
        if options.watchdog is not None:
            with self._words("clearing the watchdog", WATCHDOG_CURE):
                card.watchdog_clear()
                card.watchdog_stop()
        with self._words("setting up outputs and encoder"):
            self._write_zeros()
            modes = np.array([sdk.EncoderQuadratureMode.X4], dtype=np.int32)
            card.set_encoder_quadrature_mode(self._encoder, 1, modes)
            card.set_encoder_counts(self._encoder, 1, np.zeros(1, dtype=np.int32))
        volts, step = (-options.range, options.range), 2.0 * options.range / 2**_BITS
        name = f"Quanser {options.card} {options.identifier}"
        return CardFacts(name, _MOST_RATE, volts, step)

    def start(self, sample_rate: float, played: FloatArray | None) -> None:
        """The reader task first, so that no output goes unseen."""
        card, sdk, buffer = self._card, self._sdk, self._options.buffer
        self._guard_outputs()
        nothing = (None, 0)
        rates = (self._velocity, 1) if self._options.velocity else nothing
        n_in, n_out = len(self._inputs), len(self._outputs)
        with self._words("making the reader task"):
            self._reader = card.task_create_reader(
                buffer, self._inputs, n_in, self._encoder, 1, *nothing, *rates
            )
        # A card that does not know this mode ends the run where samples are lost instead.
        with suppress(sdk.HILError):
            mode = importlib.import_module("quanser.hardware.enumerations").BufferOverflowMode
            card.task_set_buffer_overflow_mode(self._reader, mode.OVERWRITE_ON_OVERFLOW)
        self._overflows = 0
        if played is not None:
            with self._words("making the writer task"):
                self._writer = card.task_create_writer(
                    buffer, self._outputs, n_out, *nothing, *nothing, *nothing
                )
            self.play(played)
        for task in filter(None, (self._reader, self._writer)):
            with self._words(f"starting to sample at {sample_rate:g} Hz"):
                card.task_start(task, sdk.Clock.HARDWARE_CLOCK_0, sample_rate, sdk.HIL.INFINITE)

    def read(self, n: int) -> Reading:
        """Samples that the reader task has kept; blocks for the rest."""
        analog, counts = np.zeros(n * len(self._inputs)), np.zeros(n, dtype=np.int32)
        rates = np.zeros(n) if self._options.velocity else None
        with self._words("reading samples"):
            n_read = self._card.task_read(self._reader, n, analog, counts, None, rates)
            overflows = self._card.task_get_buffer_overflows(self._reader)
        if n_read != n:
            raise DeviceError(
                f"the card has stopped sampling: {n_read} of {n} samples came",
                cure="look after its cable and its supply",
            )
        lost, self._overflows = overflows - self._overflows, overflows
        return Reading(analog.reshape(n, -1), counts.astype(np.int64), rates, lost)

    def play(self, volts: FloatArray) -> None:
        """Hand volts (n, 2) to the writer task; there is room for them."""
        if len(volts) == 0:
            return
        with self._words("handing commands on"):
            flat = np.ascontiguousarray(volts, dtype=np.float64).ravel()
            self._card.task_write(self._writer, len(volts), flat, None, None, None)

    def write(self, volts: FloatArray) -> None:
        """Put out volts (2,) now."""
        with self._words("putting out a command"):
            self._card.write_analog(self._outputs, len(self._outputs), np.array(volts))

    def feed(self) -> None:
        """Reload the watchdog."""
        if not self._guarded:
            return
        with self._words("reloading the watchdog"):
            in_time = self._card.watchdog_reload()
        if not in_time:
            raise DeviceError(
                f"the card heard nothing for {self._options.watchdog:g} s (options.watchdog): its "
                "watchdog has zeroed the outputs",
                cure="see what else this computer does ('rig doctor'), or allow it more time",
            )

    def zero(self) -> None:
        """Stop the writer task, if there is one, and put out zeros."""
        writer, self._writer = self._writer, None
        try:
            if writer is not None:
                self._end(writer)
        finally:
            with self._words("zeroing the outputs"):
                self._write_zeros()

    def stop(self) -> None:
        """Zero outputs, then no task and no watchdog any more."""
        reader, self._reader = self._reader, None
        steps: list[Callable[[], None]] = [self.zero]
        if reader is not None:
            steps.append(lambda: self._end(reader))
        if self._guarded:
            steps.append(self._release)
        all_steps(steps)

    def close(self) -> None:
        """Disconnect."""
        card = self._card
        if card is None:
            return
        try:
            self.stop()
        finally:
            self._card = None
            with self._words("closing the card"):
                card.close()

    def _guard_outputs(self) -> None:
        """Start the watchdog, which zeroes every output of the card."""
        seconds = self._options.watchdog
        if seconds is None:
            return
        outputs = np.arange(self._options.analog_outputs, dtype=np.uint32)
        with self._words("starting the watchdog", WATCHDOG_CURE):
            self._card.watchdog_clear()
            zeros = np.zeros(len(outputs))
            self._card.watchdog_set_analog_expiration_state(outputs, len(outputs), zeros)
            self._card.watchdog_start(seconds)
        self._guarded = True

    def _release(self) -> None:
        self._guarded = False
        with self._words("stopping the watchdog"):
            self._card.watchdog_stop()

    def _end(self, task: Any) -> None:
        stop, delete = self._card.task_stop, self._card.task_delete
        with self._words("ending a task"):
            try:
                stop(task)
            finally:
                delete(task)

    def _write_zeros(self) -> None:
        n = len(self._outputs)
        self._card.write_analog(self._outputs, n, np.zeros(n))

    @contextmanager
    def _words(self, what: str, cure: str = "") -> Iterator[None]:
        """The library's errors in words."""
        try:
            yield
        except self._sdk.HILError as error:
            raise DeviceError(
                f"{what} failed: {error.get_error_message()}",
                cure=cure
                or "look after the card, its cable and its supply, and whether another "
                "program uses it",
            ) from error


class QuanserDevice(CardDevice):
    """A rig on a card of Quanser."""

    Options = QuanserOptions

    def __init__(
        self, options: QuanserOptions, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        super().__init__(options, QuanserCard(options), clock)


def _numbers(*channels: int) -> _Channels:
    return np.array(channels, dtype=np.uint32)


def _sdk() -> Any:
    """The SDK's module; ConfigError where it is not installed."""
    try:
        return importlib.import_module("quanser.hardware")
    except ImportError as error:
        raise ConfigError(
            f"the backend 'quanser' needs the Python module quanser.hardware ({error})",
            cure="install the Quanser SDK, then its Python packages into this environment "
            "(docs/boards.md); 'rig check' does without",
            key="backend",
        ) from None
