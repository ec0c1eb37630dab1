"""A fake of ``quanser.hardware``: a card by the documentation of the HIL library.

Arguments are checked as the C library and its Python layer describe them: channels are arrays of
32-bit whole numbers with as many elements as are named beside them, volts and rates arrays of
float64, counts of int32, all long enough for the samples asked for. What the documentation names
an error for raises ``HILError`` with it; what it forbids without naming one is a ``MisuseError``.
"""

import array

import bench_world
import numpy as np
from bench_world import MisuseError, Reader, UnpluggedError, Writer

from quanser.hardware.enumerations import BufferOverflowMode, Clock, EncoderQuadratureMode

__all__ = ["HIL", "BufferOverflowMode", "Clock", "EncoderQuadratureMode", "HILError"]

_ANALOG, _ENCODERS, _BUFFER_OVERFLOW = 8, 8, 111
_OTHER = range(14_000, 14_000 + _ENCODERS)
_TEXTS = {
    1: "Not enough memory to perform the operation.",
    3: "A value is outside the valid range.",
    4: "One of the arguments is invalid.",
    6: "The specified option or operation is not supported.",
    88: "The given card handle is not a valid card.",
    105: "An invalid task handle was passed as an argument to a HIL function.",
    108: "The driver for the specified card could not be found, or the card is not there.",
    109: "The board is in use by another process.",
    111: "The buffer has overflowed, or there is no more data left in it.",
    121: "One of the analog input channels that was specified is not a valid channel number.",
    124: "One of the encoder input channels that was specified is not a valid channel number.",
    130: "One of the other input channels that was specified is not a valid channel number.",
    591: "The hil_watchdog_set_analog_expiration_state function is not supported by this card.",
    595: "The hil_watchdog_start function is not supported by this particular card.",
    596: "The hil_watchdog_stop function is not supported by this particular card.",
    597: "The hil_watchdog_reload function is not supported by this particular card.",
    599: "The hil_watchdog_clear function is not supported by this particular card.",
    601: "This board only supports resetting the analog outputs to zero.",
    604: "Some of the analog output expiration states have not been configured.",
}


class HILError(Exception):
    """An error of the HIL library."""

    def __init__(self, error_code):
        super().__init__(error_code)
        self.error_code = -error_code

    def get_error_message(self, locale=None):
        """The library's text for it."""
        return _TEXTS[-self.error_code]


def _call(method):
    """A method of an open card: counted, and gone with the card."""

    def checked(self, *args):
        if self._world is None:
            raise HILError(88)
        try:
            self._world.count_call(method.__name__)
            return method(self, *args)
        except UnpluggedError:
            raise HILError(108) from None

    checked.__name__, checked.__doc__ = method.__name__, method.__doc__
    return checked


def _whole(value, what):
    if not isinstance(value, int | np.integer):
        raise TypeError(f"{what} must be a whole number, not {type(value).__name__}")
    return int(value)


def _elements(values, codes, dtype, n, what):
    """An array of the C type, at least n long."""
    if isinstance(values, np.ndarray):
        if values.dtype not in [np.dtype(kind) for kind in dtype]:
            raise TypeError(f"{what} must be of {dtype}, not {values.dtype}")
        if values.ndim != 1 or not values.flags.c_contiguous:
            raise TypeError(f"{what} must be one row of memory")
    elif isinstance(values, array.array):
        if values.typecode not in codes:
            raise TypeError(f"{what} must be an array of {codes}, not of {values.typecode}")
    else:
        raise TypeError(f"{what} must be an array, not {type(values).__name__}")
    if len(values) < n:
        raise MisuseError(
            f"{what} has {len(values)} elements where {n} are read or written: memory"
        )
    return values


def _channels(values, n, error, valid, what):
    n = _whole(n, f"number of {what}")
    if values is None:
        if n:
            raise MisuseError(f"{n} {what} without an array of them")
        return []
    numbers = _elements(values, "iIlL", ["uint32", "int32"], n, what)
    if len(numbers) != n:
        raise MisuseError(f"{len(numbers)} {what} in the array, and {n} said")
    if any(int(number) not in valid for number in numbers):
        raise HILError(error)
    return [int(number) for number in numbers]


def _doubles(values, n, what):
    if n == 0:
        if values is not None:
            raise MisuseError(f"{what} without channels")
        return None
    return _elements(values, "d", ["float64"], n, what)


def _volts(values, n, what):
    volts = np.array(_doubles(values, n, what)[:n])
    if not (np.abs(volts) <= 10.0).all():
        raise HILError(3)
    return volts


class _Task:
    """A handle. channels: by kind; item: of the bench."""

    def __init__(self, card, item, **channels):
        self.card, self.item, self.channels = card, item, channels
        self.rate = None
        self.deleted = False


class HIL:
    """A card."""

    INFINITE = 2**32 - 1

    def __init__(self, card_type=None, card_identifier=None):
        self._world = None
        self._tasks = []
        if card_type is not None:
            self.open(card_type, card_identifier)

    def open(self, card_type, card_identifier):
        """Connect."""
        if not isinstance(card_type, str) or not isinstance(card_identifier, str):
            raise TypeError("card_type and card_identifier must be text")
        if self._world is not None:
            raise MisuseError("the card is open already")
        if (card_type, card_identifier) not in {("qpid", "0"), ("qpid_e", "0")}:
            raise HILError(108)
        world = bench_world.world(card_type)
        if getattr(world, "owner", None) is not None:
            raise HILError(109)
        try:
            world.count_call("open")
        except UnpluggedError:
            raise HILError(108) from None
        world.owner, self._world = self, world
        self._offset, self._mode, self._states = 0, 0, {}

    def is_valid(self):
        """Whether it is open."""
        return self._world is not None

    def close(self):
        """Disconnect; tasks end, outputs stay as they are."""
        if self._world is None:
            raise HILError(88)
        for task in list(self._tasks):
            self._world.end(task.item)
            task.deleted = True
        self._tasks = []
        self._world.owner = None
        world, self._world = self._world, None
        world.calls["close"] = world.calls.get("close", 0) + 1

    @_call
    def set_encoder_quadrature_mode(self, channels, num_channels, modes):
        """Counts for each cycle."""
        numbers = _channels(channels, num_channels, 124, range(_ENCODERS), "encoders")
        modes = _elements(modes, "iIlL", ["int32", "uint32"], len(numbers), "modes")
        if any(int(mode) not in (0, 1, 2, 4) for mode in modes):
            raise HILError(4)
        self._mode = int(modes[0])

    @_call
    def set_encoder_counts(self, channels, num_channels, counts):
        """What the counters show now."""
        numbers = _channels(channels, num_channels, 124, range(_ENCODERS), "encoders")
        _elements(counts, "il", ["int32"], len(numbers), "counts")
        self._offset = int(counts[0]) - int(np.floor(self._world.count))

    @_call
    def write_analog(self, channels, num_channels, buffer):
        """Put out volts now; nothing where the watchdog has expired."""
        numbers = _channels(channels, num_channels, 121, range(_ANALOG), "analog outputs")
        volts = _volts(buffer, len(numbers), "volts")
        if any(task.item in self._world.writers for task in self._tasks):
            raise MisuseError("a writer task puts out volts at the same time")
        outputs = self._world.outputs.copy()
        for number, value in zip(numbers, volts, strict=True):
            if number < len(outputs):
                outputs[number] = value
        self._world.set_outputs(outputs)

    @_call
    def task_create_reader(
        self, samples_in_buffer, analog_channels, num_analog_channels, encoder_channels,
        num_encoder_channels, digital_channels, num_digital_channels, other_channels,
        num_other_channels,
    ):  # fmt: skip
        """A task that keeps samples."""
        analog = _channels(
            analog_channels, num_analog_channels, 121, range(_ANALOG), "analog inputs"
        )
        encoders = _channels(
            encoder_channels, num_encoder_channels, 124, range(_ENCODERS), "encoders"
        )
        other = _channels(other_channels, num_other_channels, 130, _OTHER, "other inputs")
        if digital_channels is not None or _whole(num_digital_channels, "number of lines"):
            raise MisuseError("this bench has no digital lines")
        if encoders and self._mode != EncoderQuadratureMode.X4:
            raise MisuseError("the encoder is read before it was set to count four a cycle")
        if self._of(Reader):
            raise MisuseError("a reader is still there: a task that is no longer used is deleted")
        reader = Reader(_whole(samples_in_buffer, "samples_in_buffer"))
        return self._task(reader, analog=analog, encoders=encoders, other=other)

    @_call
    def task_create_writer(
        self, samples_in_buffer, analog_channels, num_analog_channels, pwm_channels,
        num_pwm_channels, digital_channels, num_digital_channels, other_channels,
        num_other_channels,
    ):  # fmt: skip
        """A task that puts out samples."""
        analog = _channels(
            analog_channels, num_analog_channels, 121, range(_ANALOG), "analog outputs"
        )
        for channels, n in (
            (pwm_channels, num_pwm_channels),
            (digital_channels, num_digital_channels),
            (other_channels, num_other_channels),
        ):
            if channels is not None or n != 0:
                raise MisuseError("this bench has analog outputs only")
        return self._task(Writer(_whole(samples_in_buffer, "samples_in_buffer")), analog=analog)

    @_call
    def task_set_buffer_overflow_mode(self, task, mode):
        """What happens where the buffer is full, if the card supports it."""
        self._valid(task)
        if not self._world.settings.overwrites:
            raise HILError(6)
        names = {0: "error", 1: "overwrite", 2: "discard"}
        if mode not in names:
            raise HILError(6)  # of simulated cards only
        task.item.mode = names[mode]

    @_call
    def task_get_buffer_overflows(self, task):
        """How often samples were lost since the start."""
        self._valid(task)
        return task.item.overflows if task.item.mode != "error" else 0

    @_call
    def task_start(self, task, clock, frequency, num_samples):
        """Begin at the next edge of a clock."""
        self._valid(task)
        if clock != Clock.HARDWARE_CLOCK_0:
            raise MisuseError("samples that another clock times than the card's first")
        if not 0.0 < float(frequency) <= 1e5:
            raise HILError(3)
        if _whole(num_samples, "num_samples") != HIL.INFINITE:
            raise MisuseError("a run of so many samples ends by itself")
        if task.rate is not None:
            raise MisuseError("the task has been started")
        if isinstance(task.item, Writer) and not task.item.rows:
            raise MisuseError(
                "a writer is filled before it is started, or puts out nothing at first"
            )
        if isinstance(task.item, Reader) and self._of(Writer):
            raise MisuseError("nobody sees what the writer puts out before this reader starts")
        task.rate = frequency
        self._world.start_clock(frequency)
        self._world.begin(task.item)

    @_call
    def task_read(
        self, task, num_samples, analog_buffer, encoder_buffer, digital_buffer, other_buffer
    ):
        """Samples that the task has kept; waits for those missing. How many there are."""
        self._valid(task)
        n, reader, channels = _whole(num_samples, "num_samples"), task.item, task.channels
        if not isinstance(reader, Reader):
            raise HILError(105)
        if n < 1 or n > reader.capacity:
            raise MisuseError(f"{n} samples at once of a buffer for {reader.capacity}")
        analog = _doubles(analog_buffer, n * len(channels["analog"]), "analog_buffer")
        rates = _doubles(other_buffer, n * len(channels["other"]), "other_buffer")
        counts = _elements(encoder_buffer, "il", ["int32"], n, "encoder_buffer")
        if digital_buffer is not None:
            raise MisuseError("digital_buffer without channels")
        if task.rate is None:
            return 0  # a task that does not run has no samples
        while len(reader.rows) < n and not reader.failed:
            self._world.wait_for_edge()
            if self._world.gone:
                raise HILError(108)
        if reader.failed:
            raise HILError(_BUFFER_OVERFLOW)
        for k in range(n):
            volts, count, rate = reader.rows.popleft()
            for j, number in enumerate(channels["analog"]):
                analog[k * len(channels["analog"]) + j] = volts[number] if number < 3 else 0.0
            shown = (int(np.floor(count)) + self._offset + 2**23) % 2**24 - 2**23
            counts[k] = shown
            if rates is not None:
                rates[k] = rate
        return n

    @_call
    def task_write(
        self, task, num_samples, analog_buffer, pwm_buffer, digital_buffer, other_buffer
    ):
        """More samples to put out; waits for room. How many were taken."""
        self._valid(task)
        n, writer = _whole(num_samples, "num_samples"), task.item
        if not isinstance(writer, Writer):
            raise HILError(105)
        n_channels = len(task.channels["analog"])
        volts = _volts(analog_buffer, n * n_channels, "analog_buffer").reshape(n, n_channels)
        if (pwm_buffer, digital_buffer, other_buffer) != (None, None, None):
            raise MisuseError("a buffer without channels")
        if n < 1 or n > writer.capacity:
            raise MisuseError(f"{n} samples at once into a buffer for {writer.capacity}")
        if writer.ran_dry:
            raise HILError(_BUFFER_OVERFLOW)
        while len(writer.rows) + n > writer.capacity:
            if task.rate is None:
                raise MisuseError(
                    "a buffer is overfilled that nobody empties: this would never end"
                )
            self._world.wait_for_edge()
        writer.rows.extend(volts)
        return n

    @_call
    def task_stop(self, task):
        """End a task; it may be started again."""
        self._valid(task)
        self._world.end(task.item)
        task.rate = None

    @_call
    def task_delete(self, task):
        """Give a task back."""
        self._valid(task)
        if task.rate is not None:
            raise MisuseError("a task is deleted while it runs")
        task.deleted = True
        self._tasks.remove(task)

    @_call
    def watchdog_set_analog_expiration_state(self, channels, num_channels, voltages):
        """Volts of the outputs once the watchdog has expired."""
        self._supported(591)
        numbers = _channels(channels, num_channels, 121, range(_ANALOG), "analog outputs")
        volts = _doubles(voltages, len(numbers), "voltages")
        if self._world.armed:
            raise MisuseError("expiration states are set before the watchdog is started")
        if any(volts):
            raise HILError(601)
        self._states = dict(zip(numbers, volts, strict=False))

    @_call
    def watchdog_start(self, timeout):
        """Begin to watch."""
        self._supported(595)
        if not 0.0 < float(timeout) <= 0.42 * 100:
            raise HILError(3)
        if set(self._states) != set(range(_ANALOG)):
            raise HILError(604)
        self._world.arm(float(timeout), [0.0, 0.0])

    @_call
    def watchdog_reload(self):
        """Whether it was in time."""
        self._supported(597)
        if not self._world.armed:
            raise MisuseError("a watchdog is reloaded that was not started")
        return self._world.reload()

    @_call
    def watchdog_is_expired(self):
        """Whether it has."""
        self._supported(597)
        return self._world.expired

    @_call
    def watchdog_clear(self):
        """Allow outputs again."""
        self._supported(599)
        self._world.clear()

    @_call
    def watchdog_stop(self):
        """End watching; an expired one stays so."""
        self._supported(596)
        self._world.disarm()

    def _supported(self, error):
        if not self._world.settings.watchdog:
            raise HILError(error)

    def _of(self, kind):
        """Tasks of a kind that are there; of writers, those that run."""
        tasks = [task for task in self._tasks if isinstance(task.item, kind)]
        return [task for task in tasks if kind is Reader or task.rate is not None]

    def _task(self, item, **channels):
        if item.capacity < 1:
            raise HILError(4)
        task = _Task(self, item, **channels)
        self._tasks.append(task)
        return task

    def _valid(self, task):
        if not isinstance(task, _Task) or task.deleted or task.card is not self:
            raise HILError(105)
