"""What a backend may hand over and raise, and what becomes of a run where it does otherwise."""

import dataclasses
import json

import numpy as np
import pytest

from daq.config.rig import RigConfig
from daq.errors import DeviceError
from daq.hal import Mode
from daq.rig import Rig
from sim_rig.backend import SimulatedDevice, Simulation
from tests.daq.support import only_capture, record_of, rig, write_experiment, write_rig
from tests.soak import mostly_soak

N = 4  # samples in a block


class Handing(SimulatedDevice):
    """Hands over something else than it should: ``info``, ``block``, ``facts`` or ``free``."""

    info = block = staticmethod(lambda value: value)
    free, facts = N, {}

    def open(self):
        return self.info(super().open())

    def receive(self):
        return self.block(super().receive())

    def room(self):
        return self.free

    def report(self):
        return self.facts


def opened(**handed):
    device = Handing(Simulation())
    vars(device).update(handed)
    started = Rig(device, RigConfig())
    started.open()
    return started


def received(block):
    """What a rig makes of a block of four samples as the function changes it."""
    started = opened(block=block)
    started.start(800.0, Mode.OPEN_LOOP)
    started.send(0, np.zeros((N, 2)))
    return started.receive()


def changed(name, change):
    return lambda raw: dataclasses.replace(raw, **{name: change(getattr(raw, name))})


def every(change):
    return lambda raw: type(raw)(*(change(value) for value in vars(raw).values()))


WRONG_BLOCKS = {
    "none": (lambda raw: None, "returned NoneType from receive"),
    "a dictionary": (vars, "returned dict from receive"),
    "no rows": (every(lambda values: values[:0]), "a block without samples"),
    "ticks repeat": (changed("tick", lambda tick: tick * 0), "tick 0 behind tick 0"),
    "ticks below zero": (changed("tick", lambda tick: tick - 5), "tick -5 behind tick -1"),
    "ticks fall": (changed("tick", lambda tick: tick[::-1]), "tick 2 behind tick 3"),
    "halves": (changed("tick", lambda tick: tick + 0.5), "tick of .* float64; whole numbers"),
    "short": (changed("counts", lambda counts: counts[1:]), r"counts of shape \(3,\)"),
    "scalar": (changed("count_rate", lambda rate: 1.0), r"count_rate of shape \(\)"),
    "one column": (changed("analog", lambda volts: volts[:, :1]), r"analog of shape \(4, 1\)"),
    "transposed": (changed("analog", np.transpose), r"analog of shape \(3, 4\)"),
    "three outputs": (changed("applied", lambda v: v[:, [0, 1, 1]]), r"applied of shape \(4, 3\)"),
    "complex": (changed("analog", lambda volts: volts + 1j), "complex128; real numbers"),
    "text": (changed("analog", lambda volts: volts.astype(str)), "analog of .*; real numbers"),
    "ragged": (changed("applied", lambda volts: [[0.0, 0.0], [0.0]]), "applied of .* object"),
    "ragged ticks": (changed("tick", lambda tick: [[0], [1, 2]]), "tick of .* object"),
    "flags of floats": (changed("flags", lambda flags: flags + 0.0), "flags of .*; whole numbers"),
    "no flags": (changed("flags", lambda flags: None), "flags of .* object; whole numbers"),
}


@pytest.mark.parametrize("block, words", WRONG_BLOCKS.values(), ids=WRONG_BLOCKS)
def test_a_block_that_breaks_the_contract_is_refused_by_the_name_of_its_field(block, words):
    with pytest.raises(DeviceError, match=words) as refusal:
        received(block)
    assert "mend the backend" in refusal.value.cure


def test_a_block_that_comes_twice_is_refused():
    blocks = []
    started = opened(block=lambda raw: blocks.append(raw) or blocks[0])
    started.start(800.0, Mode.OPEN_LOOP)
    started.send(0, np.zeros((N, 2)))
    started.receive()
    started.send(N, np.zeros((N, 2)))
    with pytest.raises(DeviceError, match="tick 0 behind tick 3"):
        started.receive()


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.int64])
def test_real_numbers_of_any_width_are_taken_as_floats(kind):
    samples = received(changed("analog", lambda volts: np.ones_like(volts, dtype=kind)))
    assert samples.current_motor.dtype == np.float64


def test_ticks_of_any_whole_type_are_taken_and_masks_hide_nothing():
    assert received(changed("tick", lambda tick: tick.astype(np.uint32))).tick.tolist() == [
        *range(N)
    ]
    masked = changed("analog", lambda volts: np.ma.masked_array(volts * 0.0 + 7.0, mask=True))
    assert type(received(masked).current_motor) is np.ndarray


@pytest.mark.parametrize(
    "flags, kept", [(True, 1), (np.uint8(34), 34), (-1, 187), (1 << 40, 0), (4 | 64 | 2, 2)]
)
def test_of_the_flags_a_device_sets_only_its_own(flags, kept):
    samples = received(changed("flags", lambda old: np.full(len(old), flags)))
    assert samples.flags.dtype == np.int64 and samples.flags.tolist() == [kept] * N


WRONG_INFOS = {
    "max_rate": (0.0, float("nan")), "queue": (0, -1, 10**10, "many"), "step_out": (np.inf, -1.0),
    "volts_in": ((10.0,), (np.nan, np.nan)), "name": (None, "x" * 5000), "virtual_time": (3,),
}  # fmt: skip


@pytest.mark.parametrize("name, value", [(n, v) for n, vs in WRONG_INFOS.items() for v in vs])
def test_a_device_that_describes_itself_wrongly_is_refused(name, value):
    with pytest.raises(DeviceError, match=rf"for DeviceInfo\.{name}[.\d]* from open\(\)"):
        opened(info=lambda info: dataclasses.replace(info, **{name: value}))


def test_a_device_that_does_not_describe_itself_is_refused():
    with pytest.raises(DeviceError, match="returned NoneType from open"):
        opened(info=lambda info: None)


@pytest.mark.parametrize("room", [None, 4096.0, "4"])
def test_room_is_a_whole_number(room):
    with pytest.raises(DeviceError, match=r"from room\(\); a whole number"):
        opened(free=room).room()


def circle():
    facts = {}
    facts["self"] = facts
    return facts


@pytest.mark.parametrize(
    "facts",
    [
        {"x": object()}, circle(), {"x": b"a"}, {"x": float("nan")}, [1, 2],
        {"warnings": None}, {"warnings": "abc"}, {"warnings": [1, {"a": 2}]},
    ],
)  # fmt: skip
def test_a_report_that_no_record_can_hold_is_a_warning(facts):
    (warning,) = opened(facts=facts).report().pop("warnings")
    assert "report()" in warning and "mend the backend" in warning


def test_a_report_is_recorded_as_json_has_it_and_its_warnings_in_one_line_each():
    report = opened(facts={"x": "\udcff", 5: (1, 2), "warnings": ["\x1b[2Jall\nis well"]}).report()
    json.dumps(report).encode()
    assert report == {"x": "\udcff", "5": [1, 2], "warnings": [r"\x1b[2Jall\nis well"]}


_SPY = '''
"""The simulated rig with one method that does something else, in the run or always."""
import asyncio
import os
import signal
import time
from pathlib import Path

import numpy as np

from daq.errors import DeviceError, InterlockError
from daq.hal import Phase
from sim_rig.backend import SimulatedDevice, Simulation


class Panic(BaseException):
    """As extensions in Rust raise it."""


class Mute(Exception):
    def __str__(self):
        raise ValueError("it has no text")


def hang(*args):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)


forged = DeviceError("\\x1b[2Jno\\nrig: both outputs are zero\\udcff")
forged.add_note("both outputs are zero: read back from the device")


class Options(Simulation):
    method: str
    does: str


class Spy(SimulatedDevice):
    Options = Options
    running = False

    def __init__(self, options):
        super().__init__(options)
        inner = getattr(self, options.method)
        deed = eval(options.does)

        def instead(*args):
            if not self.running:
                return inner(*args)
            if isinstance(deed, BaseException):
                raise deed
            return deed(*args)

        instead.__name__ = options.method
        setattr(self, options.method, instead)

    def announce(self, phase, turns=0.0):
        self.running = self.running or phase is Phase.RUN
        super().announce(phase, turns)

    def report(self):
        return {"spy": 1}

    def close(self):
        super().close()
        Path("closed").touch()
'''


def run_spy(folder, method, does, **options):
    """``rig run`` on the spy: what it printed, and the record."""
    (folder / "spy.py").write_text(_SPY)
    write_experiment(folder / "e.yaml")
    options |= {"method": method, "does": does}
    write_rig(folder / "rig.yaml", backend="spy.py:Spy", options=options)
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=folder)
    assert "Traceback" not in result.stderr and "Warning" not in result.stderr, result.stderr
    return result, record_of(only_capture(folder))


# Of every method and every kind of exception one pair runs always.
EXCEPTIONS = {
    "GeneratorExit()": "GeneratorExit", "asyncio.CancelledError()": "CancelledError",
    "SystemExit(0)": "SystemExit: 0", "Panic('odd')": "Panic: odd", "StopIteration()": "StopIter",
    "Mute()": "Mute: <exception str() failed>", "DeviceError('')": "DeviceError",
    "InterlockError('boom')": "boom",
}  # fmt: skip
METHODS = ("receive", "send", "room", "stop", "announce", "safe", "close", "report")
ALWAYS = [
    ("receive", "GeneratorExit()"), ("room", "asyncio.CancelledError()"),
    ("stop", "SystemExit(0)"), ("announce", "Panic('odd')"), ("send", "StopIteration()"),
    ("close", "Mute()"), ("receive", "DeviceError('')"), ("receive", "InterlockError('boom')"),
]  # fmt: skip
PAIRS = [*ALWAYS, *sorted({(m, e) for m in METHODS[:5] for e in EXCEPTIONS} - set(ALWAYS))]


@pytest.mark.parametrize("method, error", mostly_soak(PAIRS, len(ALWAYS)))
def test_whatever_a_method_raises_the_outputs_are_looked_at_and_the_record_ends(
    tmp_path, method, error
):
    result, record = run_spy(tmp_path, method, error)
    assert result.returncode == 1 and record["status"] == "failed"
    assert EXCEPTIONS[error] in record["reason"] and record["reason"] in result.stderr
    assert "boom" in error or f"the backend failed in {method}()" in record["reason"]
    assert record["outputs"]["confirmed"] == (method not in {"receive", "stop"})
    assert ("both outputs are zero" in result.stderr) == record["outputs"]["confirmed"]
    assert method == "close" or (tmp_path / "closed").exists()


@pytest.mark.parametrize("error", mostly_soak(list(EXCEPTIONS)[2:]))
def test_outputs_of_a_device_that_cannot_be_made_safe_are_looked_at(tmp_path, error):
    result, record = run_spy(tmp_path, "safe", error)
    assert result.returncode == 1 and record["status"] == "failed"
    assert record["outputs"]["problem"] and "outputs" in result.stderr


@pytest.mark.parametrize("error", mostly_soak([*EXCEPTIONS, "lambda: {'x': b'a'}"]))
def test_a_report_that_fails_costs_no_run_but_is_said(tmp_path, error):
    result, record = run_spy(tmp_path, "report", error)
    assert result.returncode == 0 and record["status"] == "completed"
    (warning,) = record["connection"]["warnings"]
    assert f"rig: warning: {warning}\n" in result.stderr


def test_ctrl_c_ends_a_report_that_hangs_and_the_outputs_are_known(tmp_path):
    result, record = run_spy(tmp_path, "report", "hang")
    assert result.returncode == 1 and record["status"] == "stopped"
    assert record["outputs"]["confirmed"] and "both outputs are zero" in result.stderr


def test_a_backends_text_cannot_pass_for_the_programs(tmp_path):
    result, record = run_spy(tmp_path, "receive", "forged")
    assert record["reason"] == r"\x1b[2Jno\nrig: both outputs are zero\udcff"
    assert "\x1b" not in result.stderr and "read back from the device" not in result.stderr
    assert result.stderr.splitlines()[-1] == f"rig: {record['reason']}"


@pytest.mark.parametrize(
    "volts", mostly_soak(["np.inf", "[-np.inf, np.inf, 0.0]", "1e308", "np.nan"])
)
def test_readings_that_are_no_numbers_end_a_run_without_a_warning_of_the_arithmetic(
    tmp_path, volts
):
    (tmp_path / "wrong.py").write_text(f"""
import dataclasses
import numpy as np
from daq.hal import Phase
from sim_rig.backend import SimulatedDevice


class Wrong(SimulatedDevice):
    exciting = False

    def announce(self, phase, turns=0.0):
        self.exciting = self.exciting or phase is Phase.RUN

    def receive(self):
        raw = super().receive()
        if self.exciting:
            raw.analog[::2] = {volts}
        return raw
""")
    write_experiment(tmp_path / "e.yaml")
    write_rig(tmp_path / "rig.yaml", backend="wrong.py:Wrong")
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    record = record_of(only_capture(tmp_path))
    assert result.returncode == 1 and record["status"] == "interlock", result.stderr
    assert "current_motor" in record["outputs"]["problem"]
    assert "Warning" not in result.stderr


_SMALL = '''
"""The simulated rig with room for 16 commands, which loses samples while it is calibrated."""
from dataclasses import replace

from daq.errors import DeviceError
from daq.hal import Phase
from sim_rig.backend import SimulatedDevice

QUEUE = 16


class Small(SimulatedDevice):
    sent = tick = 0

    def open(self):
        return replace(super().open(), queue=QUEUE)

    def announce(self, phase, turns=0.0):
        self.loses = phase is Phase.CALIBRATION

    def start(self, *args):
        self.sent = self.tick = 0
        super().start(*args)

    def room(self):
        return QUEUE - max(0, self.sent - self.tick)

    def send(self, tick, commands):
        if len(commands) > self.room():
            raise DeviceError("more commands than there is room for")
        self.sent = tick + len(commands)
        super().send(tick, commands)

    def receive(self):
        raw = super().receive()
        while self.loses and self.tick == 0 and raw.tick[-1] < 100:
            raw = super().receive()
        self.tick = int(raw.tick[-1]) + 1
        return raw
'''


def test_a_device_with_little_room_is_never_sent_more(tmp_path):
    (tmp_path / "small.py").write_text(_SMALL)
    write_experiment(tmp_path / "e.yaml", calibration={"samples": 200})
    write_rig(tmp_path / "rig.yaml", backend="small.py:Small")
    result = rig("run", "e.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    assert result.returncode == 0, result.stderr


def test_a_backend_that_raises_what_a_signal_does_while_outputs_are_read_back_is_heard(tmp_path):
    result, record = run_spy(tmp_path, "stop", "KeyboardInterrupt('no key')")
    assert result.returncode == 1 and record["status"] in {"failed", "stopped"}
    assert record["outputs"]["problem"] == "no key"
