"""Tasks and cards."""

import bench_world
import numpy as np
from bench_world import MisuseError, Reader, UnpluggedError, Writer

from nidaqmx.constants import (
    READ_ALL_AVAILABLE,
    AcquisitionType,
    AngleUnits,
    DigitalWidthUnits,
    Edge,
    EncoderType,
    EncoderZIndexPhase,
    RegenerationMode,
    TaskMode,
    TerminalConfiguration,
    VoltageUnits,
    WatchdogAOExpirState,
)
from nidaqmx.errors import DaqError, DaqReadError, DaqWriteError

_DEVICE = "Dev1"
_TIMEBASE = 100e6  # Hz
_INPUTS = [f"{_DEVICE}/ai{k}" for k in range(8)]
_OUTPUTS = [f"{_DEVICE}/ao{k}" for k in range(2)]
_COUNTERS = [f"{_DEVICE}/ctr{k}" for k in range(4)]
_CLOCK, _TRIGGER = f"/{_DEVICE}/ai/SampleClock", f"/{_DEVICE}/ai/StartTrigger"
_UNSET = object()


def _world():
    return bench_world.world(_DEVICE)


def _count(name):
    try:
        _world().count_call(name)
    except UnpluggedError:
        raise DaqError("Device identifier is invalid.", -200220) from None


def _tasks():
    world = _world()
    if not hasattr(world, "tasks"):
        world.tasks, world.watchdog = [], None
    return world.tasks


class Device:
    """A card by its name."""

    def __init__(self, name, *, grpc_options=None):
        self.name = name

    def _known(self):
        _count("device")
        if self.name != _DEVICE:
            raise DaqError("Device identifier is invalid.", -200220)

    @property
    def product_type(self):
        """What it is."""
        self._known()
        return "PCIe-6321"

    @property
    def serial_num(self):
        """Which."""
        self._known()
        return 0x1F2E3D4

    @property
    def ai_max_multi_chan_rate(self):
        """Of all inputs together."""
        self._known()
        return 250_000.0


class Task:
    """Channels of one kind with their timing."""

    def __init__(self, new_task_name="", *, grpc_options=None):
        _count("Task")
        self.name = new_task_name or f"_unnamedTask<{len(_tasks())}>"
        self._handle = object()
        self._reserved = self._running = False
        self._kind, self._channels = None, []
        self._timing, self._triggers = Timing(self), _Triggers(self)
        self.item = None
        self.in_stream, self.out_stream = InStream(self), OutStream(self)
        self.ai_channels = AIChannelCollection(self)
        self.ao_channels = AOChannelCollection(self)
        self.ci_channels = CIChannelCollection(self)
        _tasks().append(self)

    @property
    def timing(self):
        """Of its samples."""
        return self._timing

    @property
    def triggers(self):
        """That start it."""
        return self._triggers

    def start(self):
        """Run."""
        self._alive("start")
        if self._running:
            return
        self._reserve()
        timing, world = self._timing, _world()
        if self._kind == "ao" and timing.rate is not None:
            if not self.item or not self.item.rows:
                raise self._error("There is nothing to generate in the buffer.", -200462)
            self._running = True
            if self._triggers.start_trigger.source is None:
                raise MisuseError("outputs that wait for nobody have no known phase to the inputs")
            return  # it waits for its trigger
        self._running = True
        if self._kind == "ai":
            waiting = [t for t in _tasks() if t._running and t is not self]
            world.start_clock(timing.samp_clk_rate)
            self.item = Reader(timing.samples)
            world.begin(self.item)
            for task in waiting:
                task._triggered()
        elif self._kind == "ci":
            self.item = Reader(timing.samples)
            if any(t._kind == "ai" and t._running for t in _tasks()):
                world.begin(self.item)  # and what came before it is missed

    def _triggered(self):
        """The inputs have started."""
        world = _world()
        if self._kind == "ci":
            world.begin(self.item)
        elif self._kind == "ao" and self._timing.rate is not None:
            delay = self._triggers.start_trigger.seconds
            self.item.offset = round(delay * self._timing.rate * bench_world.SUBSTEPS)
            world.begin(self.item)

    def stop(self):
        """End it; it may be started again."""
        self._alive("stop")
        self._end()

    def close(self):
        """Give everything back."""
        if self._handle is None:
            raise self._error("Specified task is invalid, or does not exist.", -200088)
        self._end()
        self._handle = None
        _tasks().remove(self)
        _count("close")

    def control(self, action):
        """Bring it into a state."""
        self._alive("control")
        if action is not TaskMode.TASK_RESERVE:
            raise MisuseError("a state that this fake does not know")
        self._reserve()

    def _end(self):
        if self.item is not None and self._running:
            _world().end(self.item)
        self._running = self._reserved = False

    def _reserve(self):
        if not self._channels:
            raise self._error("The task has no channels.", -200478)
        if self._reserved:
            return
        for task in _tasks():
            if task is not self and task._reserved and set(task._channels) & set(self._channels):
                raise self._error("The specified resource is reserved.", -50103)
        self._reserved = True

    def _alive(self, name):
        if self._handle is None:
            raise self._error("Specified task is invalid, or does not exist.", -200088)
        _count(name)

    def _add(self, kind, channel, known):
        self._alive(f"add {kind}")
        if self._running:
            raise self._error("The operation cannot be performed while it runs.", -200479)
        if self._kind not in (None, kind):
            raise MisuseError("channels of two kinds in a task")
        if channel not in known:
            raise self._error("Physical channel specified does not exist on this device.", -200170)
        self._kind = kind
        self._channels.append(channel)

    def _error(self, message, code):
        return DaqError(message, code, self.name)


class AIChannelCollection:
    """Analog inputs of a task."""

    def __init__(self, task):
        self._task = task

    def add_ai_voltage_chan(
        self, physical_channel, name_to_assign_to_channel="",
        terminal_config=TerminalConfiguration.DEFAULT, min_val=-5.0, max_val=5.0,
        units=VoltageUnits.VOLTS, custom_scale_name="",
    ):  # fmt: skip
        """One more."""
        if not isinstance(terminal_config, TerminalConfiguration):
            raise AttributeError("terminal_config has no value")
        if terminal_config is TerminalConfiguration.PSEUDO_DIFF or max_val > 10.0:
            raise self._task._error("Requested value is not supported.", -200077)
        self._task._add("ai", physical_channel, _INPUTS)


class AOChannelCollection:
    """Analog outputs of a task."""

    def __init__(self, task):
        self._task = task

    def add_ao_voltage_chan(
        self, physical_channel, name_to_assign_to_channel="", min_val=-10.0, max_val=10.0,
        units=VoltageUnits.VOLTS, custom_scale_name="",
    ):  # fmt: skip
        """One more."""
        self._task._add("ao", physical_channel, _OUTPUTS)
        self._task.range = min_val, max_val


class CIChannelCollection:
    """Counters of a task."""

    def __init__(self, task):
        self._task = task

    def add_ci_ang_encoder_chan(
        self, counter, name_to_assign_to_channel="", decoding_type=EncoderType.X_4,
        zidx_enable=False, zidx_val=0, zidx_phase=EncoderZIndexPhase.AHIGH_BHIGH,
        units=AngleUnits.DEGREES, pulses_per_rev=24, initial_angle=0.0, custom_scale_name="",
    ):  # fmt: skip
        """The one of an encoder."""
        if self._task._channels:
            raise MisuseError("a task has one counter")
        if decoding_type is not EncoderType.X_4 or units is not AngleUnits.TICKS:
            raise MisuseError("what is read is then not counts, four a cycle")
        self._task._add("ci", counter, _COUNTERS)
        self._task.zero = np.floor(_world().count)


class Timing:
    """Of a task."""

    def __init__(self, task):
        self._task = task
        self.rate, self.samples = None, 0

    def cfg_samp_clk_timing(
        self, rate, source="", active_edge=Edge.RISING, sample_mode=AcquisitionType.FINITE,
        samps_per_chan=1000,
    ):  # fmt: skip
        """By a clock."""
        task = self._task
        task._alive("cfg_samp_clk_timing")
        if task._running:
            raise task._error("The operation cannot be performed while it runs.", -200479)
        if sample_mode is not AcquisitionType.CONTINUOUS:
            raise MisuseError("a task that ends by itself")
        if task._kind == "ci" and source != _CLOCK:
            raise task._error("A counter has no sample clock of its own.", -200431)
        if task._kind != "ci" and source:
            raise MisuseError("this bench's inputs and outputs have clocks of their own")
        self.rate, self.samples = float(rate), int(samps_per_chan)
        if task._kind == "ao":
            task.item = task.item or Writer(0)
            task.item.capacity = max(task.item.capacity, self.samples)

    @property
    def samp_clk_rate(self):
        """What the card makes of it."""
        return _TIMEBASE / round(_TIMEBASE / self.rate)

    @property
    def samp_clk_term(self):
        """The terminal at which the clock is to be had."""
        self._task._alive("samp_clk_term")
        if not self._task._reserved:
            raise self._task._error("It is settled only once the task is reserved.", -200452)
        return _CLOCK


class _Triggers:
    def __init__(self, task):
        self._start = StartTrigger(task)

    @property
    def start_trigger(self):
        return self._start


class StartTrigger:
    """What a task waits for."""

    def __init__(self, task):
        self._task = task
        self.source, self.delay, self.delay_units = None, 0.0, None

    def cfg_dig_edge_start_trig(self, trigger_source, trigger_edge=Edge.RISING):
        """An edge at a terminal."""
        self._task._alive("cfg_dig_edge_start_trig")
        if trigger_source != _TRIGGER:
            raise self._task._error("Source terminal does not exist.", -200265)
        if self._task._running:
            raise self._task._error("The operation cannot be performed while it runs.", -200479)
        self.source = trigger_source

    @property
    def term(self):
        """The terminal at which the task's own start is to be had."""
        self._task._alive("term")
        if not self._task._reserved:
            raise self._task._error("It is settled only once the task is reserved.", -200452)
        return _TRIGGER

    @property
    def seconds(self):
        """The delay."""
        if self.delay and self.delay_units is not DigitalWidthUnits.SECONDS:
            raise MisuseError("a delay in another unit than was meant")
        return self.delay


class InStream:
    """Of samples read."""

    def __init__(self, task):
        self._task = task


class OutStream:
    """Of samples written."""

    def __init__(self, task):
        self._task = task
        self._regenerates = True

    @property
    def output_buf_size(self):
        """Samples of a channel."""
        return self._task.item.capacity

    @output_buf_size.setter
    def output_buf_size(self, val):
        if self._task.item is None:
            self._task.item = Writer(0)
        if self._task.item.rows:
            raise MisuseError("a buffer is sized behind what was written to it")
        self._task.item.capacity = int(val)

    @property
    def regen_mode(self):
        """Whether samples are put out again."""
        allowed = RegenerationMode.ALLOW_REGENERATION
        return allowed if self._regenerates else RegenerationMode.DONT_ALLOW_REGENERATION

    @regen_mode.setter
    def regen_mode(self, val):
        if self._task._running:
            raise self._task._error("It cannot be changed while it runs.", -200568)
        self._regenerates = val is RegenerationMode.ALLOW_REGENERATION


def _array(data, ndim):
    """As the package hands it to the driver: float64, a row behind the other in memory."""
    if not isinstance(data, np.ndarray) or data.dtype != np.float64:
        raise TypeError("array must have data type float64")
    if data.ndim != ndim or not data.flags.c_contiguous:
        raise TypeError("array must have flags ['C_CONTIGUOUS']")


class _ReaderBase:
    def __init__(self, task_in_stream):
        self._task = task_in_stream._task

    def _rows(self, n, timeout, name):
        task, world = self._task, _world()
        task._alive(name)
        if n == READ_ALL_AVAILABLE:
            raise MisuseError("as many samples as there are: inputs and counter then differ")
        if not task._running:
            raise task._error("Read cannot be performed while the task does not run.", -200473)
        deadline = world.now() + timeout
        while len(task.item.rows) < n and not task.item.failed:
            if task.item.first is None or world.now() > deadline:
                text = "Some or all of the samples requested have not yet been acquired."
                raise DaqReadError(text, -200284, len(task.item.rows), task.name)
            world.wait_for_edge()
        if task.item.failed:
            text = "The application is not able to keep up with the hardware acquisition."
            raise DaqReadError(text, -200279, 0, task.name)
        return [task.item.rows.popleft() for _ in range(n)]


class AnalogMultiChannelReader(_ReaderBase):
    """Of analog inputs."""

    def read_many_sample(
        self, data, number_of_samples_per_channel=READ_ALL_AVAILABLE, timeout=10.0
    ):
        """Samples, a row for each channel."""
        _array(data, 2)
        n = number_of_samples_per_channel
        if data.shape != (len(self._task._channels), n):
            raise self._task._error("the NumPy array is not shaped correctly", -1)
        rows = self._rows(n, timeout, "read_many_sample")
        places = [_INPUTS.index(channel) for channel in self._task._channels]
        for k, (volts, _, _) in enumerate(rows):
            data[:, k] = [volts[place] if place < 3 else 0.0 for place in places]
        return n


class CounterReader(_ReaderBase):
    """Of a counter."""

    def read_many_sample_double(
        self, data, number_of_samples_per_channel=READ_ALL_AVAILABLE, timeout=10.0
    ):
        """Counts, as a counter of 32 bits without a sign has them."""
        _array(data, 1)
        n = number_of_samples_per_channel
        if data.shape != (n,):
            raise self._task._error("the NumPy array is not shaped correctly", -1)
        for k, (_, count, _) in enumerate(self._rows(n, timeout, "read_many_sample_double")):
            data[k] = (np.floor(count) - self._task.zero) % 2**32
        return n


class AnalogMultiChannelWriter:
    """Of analog outputs."""

    def __init__(self, task_out_stream, auto_start=_UNSET):
        self._task, self._stream = task_out_stream._task, task_out_stream
        self._auto_start = auto_start

    def write_many_sample(self, data, timeout=10.0):
        """Samples to put out later, a row for each channel."""
        task, world = self._task, _world()
        task._alive("write_many_sample")
        _array(data, 2)
        self._checked(data, len(task._channels))
        if task.item is None:
            raise MisuseError("many samples for outputs without a clock")
        item, deadline = task.item, world.now() + timeout
        if item.ran_dry:
            if self._stream._regenerates:
                raise MisuseError("the samples before are put out for ever again")
            text = "The generation has stopped to prevent the regeneration of old samples."
            raise DaqWriteError(text, -200290, 0, task.name)
        while len(item.rows) + data.shape[1] > item.capacity:
            if not task._running or world.now() > deadline:
                text = "Some or all of the samples to write could not be written yet."
                raise DaqWriteError(text, -200292, 0, task.name)
            world.wait_for_edge()
        item.rows.extend(data.T)
        if self._stream._regenerates:
            item.again = True
        return data.shape[1]

    def write_one_sample(self, data, timeout=10):
        """Put out a sample now."""
        task = self._task
        task._alive("write_one_sample")
        _array(data, 1)
        self._checked(data, len(task._channels))
        if task._timing.rate is not None:
            raise MisuseError("a single sample for outputs with a clock")
        if not task._running:
            if self._auto_start is False:
                raise task._error("Auto start is false, and the task does not run.", -200846)
            task.start()
        if _world().expired:
            raise task._error("Write failed, because a watchdog timer expired.", -200678)
        outputs = _world().outputs.copy()
        for channel, volts in zip(task._channels, data, strict=True):
            outputs[_OUTPUTS.index(channel)] = volts
        _world().set_outputs(outputs)
        return 1

    def _checked(self, data, n):
        if data.shape[0] != n:
            raise self._task._error("the NumPy array is not shaped correctly", -1)
        low, high = self._task.range
        if not ((low <= data) & (data <= high)).all():
            raise self._task._error("Requested value is not in the range of the outputs.", -200561)


class WatchdogTask:
    """The timer of a card."""

    def __init__(self, device_name, task_name="", timeout=10, grpc_options=None):
        _count("WatchdogTask")
        if device_name != _DEVICE:
            raise DaqError("Device identifier is invalid.", -200220)
        if not _world().settings.watchdog:
            raise DaqError("Watchdog Timer is not supported on this device.", -200662)
        _tasks()
        self._timeout, self._states, self._handle = timeout, None, object()
        self._running = False

    def cfg_watchdog_ao_expir_states(self, expiration_states):
        """Volts of the outputs once it has expired."""
        self._alive("cfg_watchdog_ao_expir_states")
        if self._running:
            raise DaqError("The operation cannot be performed while it runs.", -200479)
        for state in expiration_states:
            if state.physical_channel not in _OUTPUTS:
                raise DaqError("Physical channel does not exist.", -200170)
            if state.output_type is not WatchdogAOExpirState.VOLTAGE:
                raise MisuseError("an expiration state that is no voltage")
        self._states = {s.physical_channel: float(s.expiration_state) for s in expiration_states}

    def start(self):
        """Begin to watch."""
        self._alive("watchdog start")
        if any(task._reserved for task in _tasks()):
            text = "The watchdog task cannot be reserved while other tasks are."
            raise DaqError(text, -201477)
        if set(self._states or ()) != set(_OUTPUTS):
            raise DaqError("An expiration state is not specified.", -209813)
        self._running = True
        _world().arm(self._timeout, [self._states[channel] for channel in _OUTPUTS])

    def reset_timer(self):
        """Tell it that the program lives."""
        self._alive("reset_timer")
        if not self._running:
            raise MisuseError("a watchdog is reset that does not run")
        if not _world().reload():
            raise DaqError("You cannot reset the timer of an expired watchdog.", -200644)

    def clear_expiration(self):
        """Allow outputs again."""
        self._alive("clear_expiration")
        _world().clear()

    def stop(self):
        """End watching."""
        self._alive("watchdog stop")
        self._end()

    def close(self):
        """Give the timer back."""
        self._alive("watchdog close")
        self._end()
        self._handle = None

    def _end(self):
        if self._running:
            _world().disarm()
        self._running = False

    def _alive(self, name):
        if self._handle is None:
            raise DaqError("Specified task is invalid, or does not exist.", -200088)
        _count(name)
