"""Cards of National Instruments by NI-DAQmx: analog inputs, outputs and a counter."""

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from daq.boards.card import WATCHDOG_CURE, CardFacts, CardOptions, Reading, all_steps
from daq.boards.device import CardDevice
from daq.config.base import Section
from daq.config.units import Seconds, Volts
from daq.errors import ConfigError, DeviceError
from daq.hal import ANALOG_INPUTS, CHANNELS, FloatArray

_BITS = 16  # of the outputs
_MOST_RATE = 10_000.0  # Hz, up to which Python has been seen to keep up
_RATE_TOLERANCE = 5e-5  # as good as a quartz
_EXPIRED = (-200644, -200678)  # errors by which a watchdog is known to have expired
_PATIENCE = 1.0  # s beyond the time that samples take


class NidaqmxInputs(Section):
    """Analog inputs by name."""

    current_motor: str = Field("ai0", min_length=1, description="of the motor's current sense")
    current_brake: str = Field("ai1", min_length=1, description="of the brake's current sense")
    torque: str = Field("ai2", min_length=1, description="of the torque bridge")


class NidaqmxOutputs(Section):
    """Analog outputs by name."""

    motor: str = Field("ao0", min_length=1, description="to the motor's amplifier")
    brake: str = Field("ao1", min_length=1, description="to the brake's amplifier")


class NidaqmxOptions(CardOptions):
    """Options of the NI-DAQmx backend."""

    device: str = Field("Dev1", min_length=1, description="the card's name in NI MAX")
    inputs: NidaqmxInputs = Field(NidaqmxInputs(), description="analog inputs")
    outputs: NidaqmxOutputs = Field(NidaqmxOutputs(), description="analog outputs")
    encoder: str = Field("ctr0", min_length=1, description="counter of the shaft's encoder")
    terminals: Literal["DEFAULT", "RSE", "NRSE", "DIFF", "PSEUDO_DIFF"] = Field(
        "DEFAULT", description="how the analog inputs are wired"
    )
    range: Volts = Field(10.0, gt=0.0, le=10.0, description="of inputs and outputs, either way")
    delay: Seconds = Field(
        1e-4,
        ge=0.0,
        le=0.01,
        description="from a sample to the outputs that the card times, in which all inputs are "
        "converted; 0 where the card knows no such delay",
    )


class NidaqmxCard:
    """A card of National Instruments (see ``daq.boards.card.Card`` for the methods)."""

    def __init__(self, options: NidaqmxOptions) -> None:
        self._options = options
        self._ni: Any = None
        self._inputs: Any = None  # the task that the others follow
        self._counter: Any = None
        self._playing: Any = None  # of outputs that the card times
        self._direct: Any = None  # of outputs that are written at once
        self._watchdog: Any = None
        self._expired = False

    def open(self) -> CardFacts:
        """Connect, outputs zero."""
        self._ni = ni = _library()
        options = self._options
        with self._words(f"looking for {options.device!r}"):
            device = ni.Device(options.device)
            name, serial = device.product_type, device.serial_num
            fastest = device.ai_max_multi_chan_rate / len(ANALOG_INPUTS)
        if options.watchdog is not None:
            with self._words("clearing the watchdog", WATCHDOG_CURE):
                watchdog = ni.WatchdogTask(options.device, timeout=options.watchdog)
                try:
                    watchdog.clear_expiration()
                finally:
                    watchdog.close()
        self.write(np.zeros(len(CHANNELS)))
        volts, step = (-options.range, options.range), 2.0 * options.range / 2**_BITS
        full_name = f"NI {name} {serial:X} ({options.device})"
        return CardFacts(full_name, min(fastest, _MOST_RATE), volts, step)

    def start(self, sample_rate: float, played: FloatArray | None) -> None:
        """Watchdog, then the tasks that wait for the inputs' start, and the inputs last."""
        ni, options = self._ni, self._options
        self._guard_outputs()
        continuous = ni.constants.AcquisitionType.CONTINUOUS
        clocked = {"sample_mode": continuous, "samps_per_chan": options.buffer}
        with self._words("setting up the analog inputs"):
            self._inputs = inputs = ni.Task()
            terminals = ni.constants.TerminalConfiguration[options.terminals]
            for name in ANALOG_INPUTS:
                inputs.ai_channels.add_ai_voltage_chan(
                    self._physical(getattr(options.inputs, name)),
                    terminal_config=terminals, min_val=-options.range, max_val=options.range,
                )  # fmt: skip
            inputs.timing.cfg_samp_clk_timing(sample_rate, **clocked)
            # Only then it is settled which terminals of the card the others are to follow.
            inputs.control(ni.constants.TaskMode.TASK_RESERVE)
            clock, trigger = inputs.timing.samp_clk_term, inputs.triggers.start_trigger.term
            self._require_rate(inputs.timing.samp_clk_rate, sample_rate)
        with self._words("setting up the counter of the encoder"):
            self._counter = counter = ni.Task()
            counter.ci_channels.add_ci_ang_encoder_chan(
                self._physical(options.encoder),
                decoding_type=ni.constants.EncoderType.X_4,
                units=ni.constants.AngleUnits.TICKS,
            )
            counter.timing.cfg_samp_clk_timing(sample_rate, source=clock, **clocked)
        if played is not None:
            with self._words("setting up outputs that the card times"):
                self._prepare_outputs(sample_rate, trigger, clocked)
                self.play(played)
        with self._words(f"starting to sample at {sample_rate:g} Hz"):
            for task in filter(None, (self._playing, counter, inputs)):
                task.start()

    def read(self, n: int) -> Reading:
        """Samples of inputs and counter; blocks until there are n."""
        analog, counts = np.zeros((len(ANALOG_INPUTS), n)), np.zeros(n)
        with self._words("reading samples"):
            seconds = n / self._inputs.timing.samp_clk_rate + _PATIENCE
            inputs, counter = self._inputs.in_stream, self._counter.in_stream
            self._ni.AnalogMultiChannelReader(inputs).read_many_sample(analog, n, seconds)
            self._ni.CounterReader(counter).read_many_sample_double(counts, n, seconds)
        return Reading(np.ascontiguousarray(analog.T), np.rint(counts).astype(np.int64))

    def play(self, volts: FloatArray) -> None:
        """Hand volts (n, 2) to the task of the outputs; there is room for them."""
        if len(volts) == 0:
            return
        columns = np.ascontiguousarray(volts.T, dtype=np.float64)
        with self._words("handing commands on"):
            writer = self._ni.AnalogMultiChannelWriter(self._playing.out_stream, auto_start=False)
            writer.write_many_sample(columns, _PATIENCE)

    def write(self, volts: FloatArray) -> None:
        """Put out volts (2,) now."""
        with self._words("putting out a command"):
            if self._direct is None:
                self._direct = self._output_task()
            writer = self._ni.AnalogMultiChannelWriter(self._direct.out_stream, auto_start=True)
            writer.write_one_sample(np.array(volts, dtype=np.float64), _PATIENCE)

    def feed(self) -> None:
        """Reset the watchdog's timer."""
        if self._watchdog is not None:
            expired = (
                f"reaching the watchdog, after at most {self._options.watchdog:g} s without a "
                "word (options.watchdog),"
            )
            with self._words(expired, "see what else this computer does ('rig doctor')"):
                self._watchdog.reset_timer()

    def zero(self) -> None:
        """End the task of outputs that the card times, if there is one, and put out zeros."""
        playing, self._playing = self._playing, None
        steps = [partial(self._release, playing)]
        if not self._expired:  # the watchdog has done it, and allows nobody to write
            steps.append(partial(self.write, np.zeros(len(CHANNELS))))
        all_steps(steps)

    def stop(self) -> None:
        """Zero outputs, then no task and no watchdog any more."""
        tasks = [self._inputs, self._counter]
        self._inputs = self._counter = None
        steps: list[Callable[[], None]] = [self.zero]
        steps += [partial(self._release, task) for task in tasks]
        all_steps([*steps, self._end_watchdog])

    def close(self) -> None:
        """Disconnect; the outputs keep the zeros that were put out last."""
        if self._ni is None:
            return
        try:
            all_steps([self.stop, self._end_direct])
        finally:
            self._ni = None

    def _prepare_outputs(self, sample_rate: float, trigger: str, clocked: dict[str, Any]) -> None:
        """A task that plays each sample once, from the start of the inputs on."""
        constants, options = self._ni.constants, self._options
        self._end_direct()
        self._playing = outputs = self._output_task()
        outputs.timing.cfg_samp_clk_timing(sample_rate, **clocked)
        outputs.out_stream.output_buf_size = options.buffer
        outputs.out_stream.regen_mode = constants.RegenerationMode.DONT_ALLOW_REGENERATION
        start = outputs.triggers.start_trigger
        start.cfg_dig_edge_start_trig(trigger)
        if options.delay > 0.0:
            start.delay_units = constants.DigitalWidthUnits.SECONDS
            start.delay = options.delay

    def _output_task(self) -> Any:
        task = self._ni.Task()
        for name in CHANNELS:
            channel = self._physical(getattr(self._options.outputs, name))
            task.ao_channels.add_ao_voltage_chan(
                channel, min_val=-self._options.range, max_val=self._options.range
            )
        return task

    def _guard_outputs(self) -> None:
        """Start the watchdog, which some cards ask for before any task runs."""
        ni, seconds = self._ni, self._options.watchdog
        if seconds is None:
            return
        self._end_direct()
        volts = ni.constants.WatchdogAOExpirState.VOLTAGE
        outputs = [self._physical(getattr(self._options.outputs, name)) for name in CHANNELS]
        with self._words("starting the watchdog", WATCHDOG_CURE):
            self._watchdog = ni.WatchdogTask(self._options.device, timeout=seconds)
            states = [ni.AOExpirationState(output, 0.0, volts) for output in outputs]
            self._watchdog.cfg_watchdog_ao_expir_states(states)
            self._watchdog.start()

    def _end_watchdog(self) -> None:
        watchdog, self._watchdog = self._watchdog, None
        if self._expired:
            self._expired = False
            with self._words("clearing the watchdog", "reset the card in NI MAX"):
                watchdog.clear_expiration()
        self._release(watchdog)

    def _end_direct(self) -> None:
        """Give the outputs back, which belong to one task at a time."""
        direct, self._direct = self._direct, None
        self._release(direct)

    def _require_rate(self, actual: float, sample_rate: float) -> None:
        if abs(actual / sample_rate - 1.0) > _RATE_TOLERANCE:
            raise DeviceError(
                f"the card's clock cannot be divided down to {sample_rate:g} Hz; the nearest is "
                f"{actual:.9g} Hz",
                cure="set sample_rate in the experiment's file to that",
            )

    def _physical(self, channel: str) -> str:
        return f"{self._options.device}/{channel}"

    def _release(self, task: Any) -> None:
        if task is not None:
            with self._words("ending a task"):
                task.close()

    @contextmanager
    def _words(self, what: str, cure: str = "") -> Iterator[None]:
        """The driver's errors in words."""
        try:
            yield
        except self._ni.DaqError as error:
            self._expired |= self._watchdog is not None and error.error_code in _EXPIRED
            raise DeviceError(
                f"{what} failed: {str(error).strip().splitlines()[0]} ({error.error_code})",
                cure=cure
                or "look after the card, its cable and its supply, whether another "
                "program uses it, and what NI MAX says of it",
            ) from error
        except (self._ni.DaqNotFoundError, self._ni.DaqNotSupportedError) as error:
            raise ConfigError(
                f"the backend 'nidaqmx' needs NI's driver ({str(error).splitlines()[0]})",
                cure="install it with 'python -m nidaqmx installdriver', or from NI's site; "
                "'rig check' does without",
                key="backend",
            ) from None


class NidaqmxDevice(CardDevice):
    """A rig on a card of National Instruments."""

    Options = NidaqmxOptions

    def __init__(
        self, options: NidaqmxOptions, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        super().__init__(options, NidaqmxCard(options), clock)


def _library() -> Any:
    """What is used of the package ``nidaqmx``; ConfigError where it is not installed."""
    try:
        modules = [
            importlib.import_module(f"nidaqmx{name}")
            for name in (
                "", ".constants", ".errors", ".system", ".system.watchdog", ".types",
                ".stream_readers", ".stream_writers",
            )
        ]  # fmt: skip
    except ImportError as error:
        raise ConfigError(
            f"the backend 'nidaqmx' needs the Python package nidaqmx ({error})",
            cure="install it with 'python -m pip install \"hybrid-rig[nidaqmx]\"'; 'rig check' "
            "does without",
            key="backend",
        ) from None
    package, constants, errors, system, watchdog, types, readers, writers = modules
    return SimpleNamespace(
        constants=constants,
        Task=package.Task,
        DaqError=errors.DaqError,
        DaqNotFoundError=errors.DaqNotFoundError,
        DaqNotSupportedError=errors.DaqNotSupportedError,
        Device=system.Device,
        WatchdogTask=watchdog.WatchdogTask,
        AOExpirationState=types.AOExpirationState,
        AnalogMultiChannelReader=readers.AnalogMultiChannelReader,
        CounterReader=readers.CounterReader,
        AnalogMultiChannelWriter=writers.AnalogMultiChannelWriter,
    )
