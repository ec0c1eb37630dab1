"""Experiments whose loop the device's own torque controller closes: what it is told, and the log.

The firmware itself answers in ``tests/firmware/test_law.py`` and, by ``rig run`` over a wire, in
``test_real_time.py``. Here a device plays nothing and notes what comes.
"""

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest
import yaml

from daq.config.rig import RigConfig
from daq.errors import ConfigError, DeviceError
from daq.hal import Flag
from daq.lookup.classes import find_class
from daq.lookup.controllers import load_controller
from daq.run.runner import run_experiment
from daq.serial.host import refusal
from daq.serial.messages import Reply, Result, Type
from sim_rig.backend import SimulatedDevice, Simulation
from tests.protocols.closed_loop import SHIPPED

CONTROLLER = "simulated_controller.yaml"


class Aboard(SimulatedDevice):
    """Says that it has a controller, which gives zero commands for any reference."""

    def __init__(self, law):
        super().__init__(Simulation())
        self.law, self.orders, self.references, self.scales, self.raw = law, [], {}, [], None
        self.last = -1  # tick that was received

    def open(self):
        return dataclasses.replace(super().open(), law=self.law)

    def start(self, *arguments):
        super().start(*arguments)
        self.last, self.references = -1, {}

    def answer(self, first, blend, scales):
        assert first > self.last, "an order is for a tick to come"
        assert not self.orders or self.orders[-1][0] <= self.last, "the one before was carried out"
        self.orders.append((first, blend, scales is not None))
        self.scales += [scales] if scales else []

    def _is_on(self, ticks):
        answers = np.zeros(len(ticks), dtype=bool)
        for first, _, on in self.orders:
            answers[ticks >= first] = on
        return answers

    def send(self, tick, commands):
        if self.orders:
            self.references |= dict(enumerate(commands.tolist(), tick))
            commands = np.zeros_like(commands)
        super().send(tick, commands)

    def receive(self):
        raw = super().receive()
        self.last = raw.tick.item(-1)
        flags = np.where(self._is_on(raw.tick), raw.flags | int(Flag.LAW), raw.flags)
        self.raw = raw if self.orders else None
        return dataclasses.replace(raw, flags=flags)


def experiment(protocol, **changes):
    content = yaml.safe_load((SHIPPED / f"{protocol}.yaml").read_text("utf-8"))
    content |= {"on_device": True, "calibration": {"samples": 400}, "protocol": protocol, **changes}
    return find_class("protocol", protocol, SHIPPED)(**content)


def fingerprint():
    tuned = load_controller(CONTROLLER, SHIPPED)
    return tuned.control.program(tuned.model, tuned.parameters).fingerprint


def run(folder, protocol, device, limits=None, **changes):
    config = RigConfig(limits=limits or {"command": {"motor": [-5.0, 5.0], "brake": [0.0, 0.38]}})
    result = run_experiment(experiment(protocol, **changes), "e", config, device, folder)
    return pd.read_csv(result.folder / "log.csv")


def test_a_reference_is_played_to_the_controller(tmp_path):
    device = Aboard(fingerprint())
    log = run(tmp_path, "torque_tracking", device, duration=2.0, torque=0.2)
    n, blend = 1600, 40
    assert device.orders == [(0, blend, True), (n - blend, blend, False)]
    # What the device makes of the motor's commands is the torque of the log's column.
    (scales,) = device.scales
    volts = np.array([device.references[k] for k in range(n)])
    assert np.abs(volts[:, 0]).max() == pytest.approx(5.0) and not volts[:, 1].any()
    np.testing.assert_allclose(scales.reference * volts[:, 0], log.torque_ref, atol=1e-9)
    assert log.torque_ref.abs().max() == pytest.approx(0.2)
    assert not log.torque_ref[n - blend :].any(), "commands again, of zero"
    # Its own commands are in the log, not the references that were sent.
    assert (log["flags"] & 128 != 0).tolist() == [True] * (n - blend) + [False] * blend
    assert not log.cmd_voltage_motor.any()


def test_the_controller_is_told_what_the_log_has(tmp_path):
    device = Aboard(fingerprint())
    log = run(tmp_path, "torque_tracking", device, duration=1.0, fade=0.1)
    (scales,), raw = device.scales, device.raw
    rows = log[log.tick.isin(raw.tick)]
    volts = raw.analog[np.isin(raw.tick, rows.tick)]
    for place, name in ((0, "current_motor"), (2, "torque")):
        slope, zero = getattr(scales, name)
        np.testing.assert_allclose(slope * volts[:, place] + zero, rows[name], atol=1e-6)
    counts = raw.counts[np.isin(raw.tick, rows.tick)]
    np.testing.assert_allclose(scales.angle * counts, rows.theta, atol=1e-9)


def test_every_second_block_of_transparency_is_the_controllers(tmp_path):
    device = Aboard(fingerprint())
    changes = {"block": 1.2, "pairs": 2, "torque_controller": CONTROLLER}
    log = run(tmp_path, "transparency", device, **changes)
    ramp = 80  # samples of 0.1 s
    assert device.orders == [(960, ramp, True), (1920, ramp, False), (2880, ramp, True)]
    assert not any(volts for row in device.references.values() for volts in row)
    within = log[log["flags"] & 128 != 0]
    assert (within.controlled[within.tick % 960 > ramp] == 1.0).all()


class HeldUp(Aboard):
    """The order to go comes behind its tick: refused, as firmware does."""

    zeroed = 0

    def answer(self, first, blend, scales):
        if scales is None:
            raise DeviceError(refusal(Reply(Type.LAW, Result.WRONG_STATE, None)))
        super().answer(first, blend, scales)

    def safe(self):
        super().safe()
        self.zeroed += 1


def test_an_order_that_comes_too_late_ends_the_run_with_what_was_logged(tmp_path):
    device = HeldUp(fingerprint())
    with pytest.raises(DeviceError, match=r"refuses LAW: .* for this computer was held up"):
        run(tmp_path, "transparency", device, block=1.2, pairs=2, torque_controller=CONTROLLER)
    assert device.orders == [(960, 80, True)] and device.zeroed > 0
    (record,) = (json.loads(path.read_text("utf-8")) for path in tmp_path.glob("*/run.json"))
    (log,) = (pd.read_csv(path) for path in tmp_path.glob("*/log.csv"))
    assert record["status"] == "failed" and "refuses LAW" in record["reason"]
    assert 960 < len(log) < 1920, "it is refused ahead of its tick, while the law still answers"
    assert not any(volts for row in device.references.values() for volts in row)


def test_blocks_of_transparency_begin_with_whole_samples_in_orders_and_column_alike():
    """641.04 samples a block would be a sample apart behind 13 blocks."""
    settings = experiment("transparency", block=0.8013, pairs=20, torque_controller=CONTROLLER)
    aboard = settings.aboard()
    (share,) = aboard.logged
    switches = np.array(aboard.switches)
    assert len(share) == len(aboard.reference) == 40 * 641 and len(switches) == 39
    begins = np.flatnonzero((np.diff(share[:-1]) == 0.0) & (np.diff(share[1:]) != 0.0)) + 1
    np.testing.assert_array_equal(begins, switches)


@pytest.mark.parametrize(
    ("law", "limits", "words"),
    [
        ("", {}, "has no controller aboard; this experiment's is"),
        ("0123abcd", {}, "has the controller 0123abcd aboard; this experiment's is"),
        (None, {"slew": {"motor": 500.0}}, "limits.slew of the rig's file would not hold"),
    ],
)
def test_what_cannot_be_answered_there_is_refused_before_anything_moves(
    tmp_path, law, limits, words
):
    device = Aboard(fingerprint() if law is None else law)
    with pytest.raises(ConfigError, match=words) as refused:
        run(tmp_path, "torque_tracking", device, limits)
    assert "on_device: false" in str(refused.value) and not device.orders


def test_another_controller_has_another_fingerprint():
    tuned = load_controller(CONTROLLER, SHIPPED)
    program = tuned.control.program(tuned.model, tuned.parameters)
    assert program.fingerprint == fingerprint()
    first, *others = program.parameters
    changed = dataclasses.replace(program, parameters=(first * (1 + 1e-6), *others))
    assert changed.fingerprint != fingerprint()
    lent = dataclasses.replace(program, parameters=(first * (1 + 1e-13), *others))
    assert lent.fingerprint == fingerprint(), "another computer's last digit is no other controller"
