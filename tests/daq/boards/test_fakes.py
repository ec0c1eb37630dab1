"""The fake cards can fail: each misuse of a library raises, and signatures are the maker's."""

import inspect
from array import array

import numpy as np
import pytest

from tests.daq.boards.support import fakes

ONE, TWO, THREE = (np.arange(n, dtype=np.uint32) for n in (1, 2, 3))
ZEROS = np.zeros(2)
NOTHING = (None, 0)


@pytest.fixture
def hil():
    """An open card of Quanser, its encoder set up."""
    with fakes():
        from quanser import hardware

        card = hardware.HIL()
        card.open("qpid", "0")
        card.set_encoder_quadrature_mode(ONE, 1, np.array([4], dtype=np.int32))
        yield hardware, card


def reader_of(card, capacity=100):
    return card.task_create_reader(capacity, THREE, 3, ONE, 1, *NOTHING, *NOTHING)


def writer_of(card, capacity=100):
    return card.task_create_writer(capacity, TWO, 2, *NOTHING, *NOTHING, *NOTHING)


def started(hardware, card, task):
    card.task_start(task, hardware.Clock.HARDWARE_CLOCK_0, 800.0, hardware.HIL.INFINITE)
    return task


def read(card, task, n, analog=None, counts=None):
    analog = np.zeros(3 * n) if analog is None else analog
    counts = np.zeros(n, dtype=np.int32) if counts is None else counts
    return card.task_read(task, n, analog, counts, None, None)


def written(card, volts, n=None, **changes):
    task = writer_of(card, **changes)
    card.task_write(task, len(volts) // 2 if n is None else n, volts, None, None, None)
    return task


def after(card, *steps):
    for step in steps:
        step()


QUANSER = {
    "a closed card": (88, lambda h, c: (c.close(), c.write_analog(TWO, 2, ZEROS))),
    "closed twice": (88, lambda h, c: (c.close(), c.close())),
    "opened twice": ("open already", lambda h, c: c.open("qpid", "0")),
    "a card in use": (109, lambda h, c: h.HIL("qpid", "0")),
    "a card that is not there": (108, lambda h, c: h.HIL("q8_usb", "0")),
    "an identifier that is no text": (TypeError, lambda h, c: h.HIL().open("qpid_e", 0)),
    "channels in a list": (TypeError, lambda h, c: c.write_analog([0, 1], 2, ZEROS)),
    "channels of 64 bits": (TypeError, lambda h, c: c.write_analog(np.arange(2), 2, ZEROS)),
    "volts of 32 bits": (
        TypeError, lambda h, c: c.write_analog(TWO, 2, np.zeros(2, dtype=np.float32))),
    "volts in a list": (TypeError, lambda h, c: c.write_analog(TWO, 2, [0.0, 0.0])),
    "volts in an array of the wrong type": (
        TypeError, lambda h, c: c.write_analog(TWO, 2, array("f", [0.0, 0.0]))),
    "every other element of an array": (
        TypeError, lambda h, c: c.write_analog(TWO, 2, np.zeros(4)[::2])),
    "too few volts": ("memory", lambda h, c: c.write_analog(TWO, 2, np.zeros(1))),
    "more channels than are said": ("said", lambda h, c: c.write_analog(THREE, 2, np.zeros(3))),
    "volts beyond the range": (3, lambda h, c: c.write_analog(TWO, 2, np.array([11.0, 0.0]))),
    "volts that are no number": (3, lambda h, c: c.write_analog(TWO, 2, np.array([np.nan, 0.0]))),
    "an output that is not there": (
        121, lambda h, c: c.write_analog(np.array([0, 8], dtype=np.uint32), 2, ZEROS)),
    "counts of 64 bits": (TypeError, lambda h, c: c.set_encoder_counts(ONE, 1, np.zeros(1, int))),
    "a quadrature mode that is none": (
        4, lambda h, c: c.set_encoder_quadrature_mode(ONE, 1, np.array([3], dtype=np.int32))),
    "a reader of a channel that is not there": (
        130,
        lambda h, c: c.task_create_reader(
            9, THREE, 3, ONE, 1, *NOTHING, np.array([14008], dtype=np.uint32), 1)),
    "a reader without a buffer": (4, lambda h, c: reader_of(c, 0)),
    "reading more at once than is kept": (
        "at once", lambda h, c: read(c, started(h, c, reader_of(c, 5)), 6)),
    "reading into too little memory": (
        "memory", lambda h, c: read(c, started(h, c, reader_of(c)), 2, analog=np.zeros(5))),
    "reading counts into floats": (
        TypeError,
        lambda h, c: read(c, started(h, c, reader_of(c)), 1, counts=np.zeros(1))),
    "reading from a writer": (105, lambda h, c: read(c, writer_of(c), 1)),
    "writing to a reader": (
        105, lambda h, c: c.task_write(reader_of(c), 1, ZEROS, None, None, None)),
    "a writer started empty": ("filled", lambda h, c: started(h, c, writer_of(c))),
    "a buffer overfilled before the start": (
        "never end", lambda h, c: after(
            c, lambda: setattr(c, "w", written(c, np.zeros(10), capacity=5)),
            lambda: c.task_write(c.w, 1, ZEROS, None, None, None))),
    "a writer that has run dry": (
        111, lambda h, c: after(
            c,
            lambda: setattr(c, "r", started(h, c, reader_of(c))),
            lambda: setattr(c, "w", started(h, c, written(c, np.zeros(10)))),
            lambda: read(c, c.r, 20),
            lambda: c.task_write(c.w, 1, ZEROS, None, None, None))),
    "a value put out while a writer plays": (
        "writer task", lambda h, c: after(
            c, lambda: started(h, c, reader_of(c)),
            lambda: started(h, c, written(c, np.zeros(10))),
            lambda: c.write_analog(TWO, 2, ZEROS))),
    "an overflow": (
        111, lambda h, c: after(
            c, lambda: setattr(c, "r", started(h, c, reader_of(c, 10))),
            lambda: c._world.pass_time(0.1), lambda: read(c, c.r, 1))),
    "started twice": (
        "has been started", lambda h, c: started(h, c, started(h, c, reader_of(c)))),
    "another clock": (
        "clock", lambda h, c: c.task_start(
            reader_of(c), h.Clock.SYSTEM_CLOCK_1, 800.0, h.HIL.INFINITE)),
    "a task used after it was deleted": (
        105, lambda h, c: after(
            c, lambda: setattr(c, "r", reader_of(c)), lambda: c.task_delete(c.r),
            lambda: read(c, c.r, 1))),
    "a reader that starts behind its writer": (
        "nobody sees", lambda h, c: after(
            c, lambda: started(h, c, written(c, np.zeros(10))),
            lambda: started(h, c, reader_of(c)))),
    "a reader beside one that was not deleted": (
        "is deleted", lambda h, c: after(c, lambda: reader_of(c), lambda: reader_of(c))),
    "a task deleted while it runs": (
        "while it runs", lambda h, c: c.task_delete(started(h, c, reader_of(c)))),
    "a watchdog without states": (604, lambda h, c: c.watchdog_start(0.1)),
    "a watchdog of some of the outputs": (
        604, lambda h, c: after(
            c, lambda: c.watchdog_set_analog_expiration_state(TWO, 2, ZEROS),
            lambda: c.watchdog_start(0.1))),
    "an expiration state that is not zero": (
        601, lambda h, c: c.watchdog_set_analog_expiration_state(TWO, 2, np.ones(2))),
    "a reload before the start": ("not started", lambda h, c: c.watchdog_reload()),
}  # fmt: skip


@pytest.mark.parametrize("misuse", list(QUANSER))
def test_each_misuse_of_a_quanser_card_raises(hil, misuse):
    import bench_world

    hardware, card = hil
    expected, act = QUANSER[misuse]
    if expected is TypeError:
        with pytest.raises(TypeError):
            act(hardware, card)
    elif isinstance(expected, int):
        with pytest.raises(hardware.HILError) as raised:
            act(hardware, card)
        assert raised.value.error_code == -expected
        assert raised.value.get_error_message().endswith(".")
    else:
        with pytest.raises(bench_world.MisuseError, match=expected):
            act(hardware, card)


def test_the_world_behind_reacts_to_what_a_quanser_card_puts_out(hil):
    hardware, card = hil
    task = started(hardware, card, reader_of(card))
    analog = np.zeros(30)
    read(card, task, 10, analog)
    assert np.abs(analog.reshape(10, 3)[:, 0]).max() < 0.1
    card.write_analog(TWO, 2, np.array([1.0, 0.0]))
    read(card, task, 10, analog)
    assert analog.reshape(10, 3)[-1, 0] > 0.5


@pytest.fixture
def ni():
    """The library, and tasks of the inputs and of the outputs that are to follow them."""
    with fakes():
        import nidaqmx
        from nidaqmx import constants, stream_readers, stream_writers, types
        from nidaqmx.system import watchdog

        class Library:
            Task, DaqError, C, T = nidaqmx.Task, nidaqmx.DaqError, constants, types
            AIReader, Writer = (
                stream_readers.AnalogMultiChannelReader,
                stream_writers.AnalogMultiChannelWriter,
            )
            CIReader, Watchdog = stream_readers.CounterReader, watchdog.WatchdogTask

            def inputs(self, timed=True, buffer=100):
                task = self.Task()
                for k in range(3):
                    task.ai_channels.add_ai_voltage_chan(f"Dev1/ai{k}", min_val=-10.0, max_val=10.0)
                if timed:
                    self.timed(task, buffer)
                return task

            def timed(self, task, buffer=100, **source):
                mode = self.C.AcquisitionType.CONTINUOUS
                task.timing.cfg_samp_clk_timing(
                    800.0, sample_mode=mode, samps_per_chan=buffer, **source
                )

            def outputs(self, trigger="/Dev1/ai/StartTrigger", regenerates=False):
                task = self.Task()
                for k in range(2):
                    task.ao_channels.add_ao_voltage_chan(f"Dev1/ao{k}")
                self.timed(task)
                task.out_stream.output_buf_size = 100
                if not regenerates:
                    task.out_stream.regen_mode = self.C.RegenerationMode.DONT_ALLOW_REGENERATION
                task.triggers.start_trigger.cfg_dig_edge_start_trig(trigger)
                return task

            def direct(self):
                task = self.Task()
                for k in range(2):
                    task.ao_channels.add_ao_voltage_chan(f"Dev1/ao{k}")
                return task

            def counter(self, source="/Dev1/ai/SampleClock"):
                task = self.Task()
                task.ci_channels.add_ci_ang_encoder_chan("Dev1/ctr0", units=self.C.AngleUnits.TICKS)
                self.timed(task, source=source)
                return task

            def play(self, task, volts):
                return self.Writer(task.out_stream, auto_start=False).write_many_sample(volts)

            def read(self, task, n, shape=None):
                data = np.zeros((3, n) if shape is None else shape)
                self.AIReader(task.in_stream).read_many_sample(data, n, 1.0)
                return data

            def guard(self, task, volts=0.0):
                state = self.T.AOExpirationState
                kind = self.C.WatchdogAOExpirState.VOLTAGE
                task.cfg_watchdog_ao_expir_states(
                    [state(f"Dev1/ao{k}", volts, kind) for k in range(2)]
                )
                return task

        yield Library()


def _ran_dry(x):
    inputs, outputs = x.inputs(), x.outputs()
    x.play(outputs, np.zeros((2, 5)))
    outputs.start(), inputs.start()
    x.read(inputs, 20)
    x.play(outputs, np.zeros((2, 5)))


def _two_tasks(x):
    outputs = x.outputs()
    x.play(outputs, np.zeros((2, 5)))
    outputs.start()
    x.Writer(x.direct().out_stream, auto_start=True).write_one_sample(np.zeros(2))


def _overflow(x):
    import bench_world

    inputs = x.inputs(buffer=10)
    inputs.start()
    bench_world.world("Dev1").pass_time(0.1)
    x.read(inputs, 1)


def _sized_late(x):
    outputs = x.outputs()
    x.play(outputs, np.zeros((2, 5)))
    outputs.out_stream.output_buf_size = 50


def _expired(x):
    import bench_world

    task = x.guard(x.Watchdog("Dev1", timeout=0.1))
    task.start()
    bench_world.world("Dev1").pass_time(0.2)
    task.reset_timer()


def _written_after_expiry(x):
    import bench_world

    x.guard(x.Watchdog("Dev1", timeout=0.1)).start()
    bench_world.world("Dev1").pass_time(0.2)
    x.Writer(x.direct().out_stream, auto_start=True).write_one_sample(np.ones(2))


def _watchdog_last(x):
    x.inputs().start()
    x.guard(x.Watchdog("Dev1", timeout=0.1)).start()


NI = {
    "a task without channels": (-200478, lambda x: x.Task().start()),
    "a channel that is not there": (
        -200170, lambda x: x.Task().ai_channels.add_ai_voltage_chan("Dev1/ai99")),
    "a closed task": (-200088, lambda x: after(x, (t := x.inputs()).close, t.start)),
    "closed twice": (-200088, lambda x: after(x, (t := x.inputs()).close, t.close)),
    "a terminal before the task is reserved": (
        -200452, lambda x: x.inputs().triggers.start_trigger.term),
    "a clock's terminal before the task is reserved": (
        -200452, lambda x: x.inputs().timing.samp_clk_term),
    "a trigger that is not there": (-200265, lambda x: x.outputs("/Dev1/ao/StartTrigger")),
    "a counter with a clock of its own": (-200431, lambda x: x.counter(source="")),
    "reading before the start": (-200473, lambda x: x.read(x.inputs(), 1)),
    "reading into the wrong shape": (
        -1, lambda x: after(x, (t := x.inputs()).start, lambda: x.read(t, 2, (2, 3)))),
    "reading into floats of 32 bits": (
        TypeError, lambda x: x.AIReader(x.inputs().in_stream).read_many_sample(
            np.zeros((3, 1), dtype=np.float32), 1)),
    "reading into columns": (
        TypeError, lambda x: x.AIReader(x.inputs().in_stream).read_many_sample(
            np.zeros((2, 3)).T, 2)),
    "an overflow": (-200279, _overflow),
    "outputs started empty": (-200462, lambda x: x.outputs().start()),
    "outputs that run dry": (-200290, _ran_dry),
    "a buffer overfilled before the start": (
        -200292, lambda x: x.play(x.outputs(), np.zeros((2, 101)))),
    "a buffer sized too late": ("sized behind", _sized_late),
    "volts beyond the range": (-200561, lambda x: x.play(x.outputs(), np.full((2, 3), 11.0))),
    "volts of one channel": (-1, lambda x: x.play(x.outputs(), np.zeros((1, 3)))),
    "volts by rows": (TypeError, lambda x: x.play(x.outputs(), np.zeros((3, 2)).T)),
    "two tasks on the same outputs": (-50103, _two_tasks),
    "outputs that nothing starts": (
        "no known phase", lambda x: after(
            x, lambda: setattr(x, "o", x.outputs()),
            lambda: setattr(x.o.triggers.start_trigger, "source", None),
            lambda: x.play(x.o, np.zeros((2, 3))), lambda: after(x, x.o.start))),
    "a value without auto start": (
        -200846, lambda x: x.Writer(x.direct().out_stream, False).write_one_sample(np.zeros(2))),
    "a watchdog of another card": (-200220, lambda x: x.Watchdog("Dev2", timeout=0.1)),
    "a watchdog without states": (-209813, lambda x: x.Watchdog("Dev1", timeout=0.1).start()),
    "a watchdog behind running tasks": (-201477, _watchdog_last),
    "a watchdog that has expired": (-200644, _expired),
    "volts after the watchdog has expired": (-200678, _written_after_expiry),
}  # fmt: skip


@pytest.mark.parametrize("misuse", list(NI))
def test_each_misuse_of_a_card_of_national_instruments_raises(ni, misuse):
    import bench_world

    expected, act = NI[misuse]
    if expected is TypeError:
        with pytest.raises(TypeError):
            act(ni)
    elif isinstance(expected, int):
        with pytest.raises(ni.DaqError) as raised:
            act(ni)
        assert raised.value.error_code == expected
    else:
        with pytest.raises(bench_world.MisuseError, match=expected):
            act(ni)


def played(x, first, regenerates=False):
    """Volts of the motor's output over 12 ticks, of tasks started in an order."""
    import bench_world

    inputs, outputs = x.inputs(), x.outputs(regenerates=regenerates)
    x.play(outputs, np.tile([1.0, 0.5, 0.25], (2, 1)))
    for task in (outputs, inputs) if first == "outputs" else (inputs, outputs):
        task.start()
    x.read(inputs, 12)
    return [volts[0] for _, volts in bench_world.world("Dev1").history]


def test_outputs_that_start_behind_the_inputs_wait_for_a_trigger_that_has_passed(ni):
    assert played(ni, "inputs") == []


def test_outputs_that_start_before_the_inputs_play_once_and_keep_the_last(ni):
    assert played(ni, "outputs") == [1.0, 0.5, 0.25]


def test_outputs_play_for_ever_where_that_is_not_forbidden(ni):
    assert played(ni, "outputs", regenerates=True) == [1.0, 0.5, 0.25] * 4


def test_a_counter_that_starts_behind_the_inputs_misses_their_first_samples(ni):
    inputs, counter = ni.inputs(), ni.counter()
    inputs.start()
    ni.read(inputs, 5)
    counter.start()
    ni.read(inputs, 5)
    with pytest.raises(ni.DaqError) as raised:
        ni.CIReader(counter.in_stream).read_many_sample_double(np.zeros(10), 10, 0.0)
    assert raised.value.error_code == -200284


REAL = {
    "Task": "task", "AIChannelCollection": "task.collections",
    "AOChannelCollection": "task.collections", "CIChannelCollection": "task.collections",
    "Timing": "task._timing", "StartTrigger": "task.triggering._start_trigger",
    "InStream": "task._in_stream", "OutStream": "task._out_stream",
    "AnalogMultiChannelReader": "stream_readers", "CounterReader": "stream_readers",
    "AnalogMultiChannelWriter": "stream_writers", "WatchdogTask": "system.watchdog",
    "Device": "system.device",
}  # fmt: skip
ATTRIBUTES = {"source", "seconds", "rate", "samples"}  # of the fake alone


def shape(function):
    """Names of parameters, with defaults that can be compared."""
    parameters = inspect.signature(function).parameters.values()
    plain = (str, int, float, bool)
    return [
        (p.name, p.default if isinstance(p.default, plain) else getattr(p.default, "name", None))
        for p in parameters
    ]


def test_signatures_enumerations_and_errors_are_those_of_the_package():
    pytest.importorskip("nidaqmx", reason="the package of National Instruments is not installed")
    from importlib import import_module

    real = {name: getattr(import_module(f"nidaqmx.{at}"), name) for name, at in REAL.items()}
    constants, errors = import_module("nidaqmx.constants"), import_module("nidaqmx.errors")
    state = import_module("nidaqmx.types").AOExpirationState._fields
    start = real["StartTrigger"]
    assert all(isinstance(getattr(start, name), property) for name in ("delay", "delay_units"))
    with fakes():
        from nidaqmx import _driver as fake
        from nidaqmx import constants as fake_constants
        from nidaqmx import errors as fake_errors
        from nidaqmx.types import AOExpirationState

        compared = 0
        for name, kind in real.items():
            for method, body in vars(getattr(fake, name)).items():
                if (method.startswith("_") and method != "__init__") or method in ATTRIBUTES:
                    continue
                theirs = getattr(kind, method)
                if isinstance(body, property):
                    assert isinstance(theirs, property), (name, method)
                elif method != "__init__" or name in {"Task", "WatchdogTask", "Device"}:
                    assert shape(body) == shape(theirs), (name, method)
                compared += 1
        assert compared > 30
        for name, kind in vars(fake_constants).items():
            if inspect.isclass(kind) and kind.__module__ == fake_constants.__name__:
                theirs = getattr(constants, name)
                assert {m.name: m.value for m in kind} == {m.name: m.value for m in theirs}, name
        for name in ("DaqError", "DaqReadError", "DaqWriteError"):
            kinds = getattr(fake_errors, name), getattr(errors, name)
            assert shape(kinds[0].__init__) == shape(kinds[1].__init__)
        assert AOExpirationState._fields == state
