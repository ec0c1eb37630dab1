"""Phases of a run: offsets of the inputs, winding of the load, the run in open or closed loop."""

import itertools
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from daq.errors import ConfigError, DeviceError, IncompleteError, RunError
from daq.experiment import Aboard, Homing, OffsetCalibration
from daq.hal import ANALOG_INPUTS, CHANNELS, Flag, FloatArray, Mode, Samples
from daq.logs.writer import LogWriter
from daq.rig import Rig
from daq.run.protocol import Dialogue
from daq.run.sampling import Sampling, before

_REST_TIME = 1.0  # s that the shaft must stand still to end homing
_REST_TURNS = 0.01  # turns it may creep meanwhile
_TURN = 2.0 * np.pi
_ROUNDING = 1.0 + 1e-9  # so that the largest reference is within the limits


def calibrate(sampling: Sampling, calibration: OffsetCalibration, record: dict[str, Any]) -> None:
    """Make the mean of the inputs at zero command their offset.

    record: what run.json holds; the noise and the offsets are added. Raises RunError for a rig
    that is not at rest.
    """
    blocks: list[Samples] = []
    n_samples = 0
    for samples in sampling.at_zero():
        blocks.append(samples)
        n_samples += len(samples)
        sampling.tell(min(n_samples, calibration.samples), calibration.samples, "samples")
        if n_samples >= calibration.samples:
            break
    sampling.rig.stop()
    turns = float(np.ptp(np.concatenate([block.theta for block in blocks]))) / _TURN
    inputs = {
        name: np.concatenate([getattr(block, name) for block in blocks]) for name in ANALOG_INPUTS
    }
    means = {name: float(values.mean()) for name, values in inputs.items()}
    # How far the offsets, and every later sample, may be trusted.
    noise = {name: float(values.std()) for name, values in inputs.items()}
    record["calibration"] = {"samples": n_samples, "noise": noise, "turns": turns}
    _require_rest(calibration, turns, means)
    sampling.rig.take_offsets(means)
    record["offsets"] = {**means, "volts": sampling.rig.offsets.tolist()}


def _require_rest(calibration: OffsetCalibration, turns: float, means: dict[str, float]) -> None:
    """Raise RunError unless what was averaged was a rig at rest."""
    if turns > calibration.motion:
        raise RunError(
            f"the shaft moved by {turns:.3g} turns at zero command, more than calibration.motion "
            f"of {calibration.motion:g} turns",
            cure="let it come to rest, keep hands off and start again",
            key="calibration",
        )
    for name in ("current_motor", "current_brake"):
        largest = getattr(calibration, name)
        if not abs(means[name]) <= largest:
            raise RunError(
                f"{name} reads {means[name]:.4g} A at zero command, more than calibration.{name} "
                f"of {largest:g} A: a current flows, or the sensor is far off. Look at the "
                "amplifier's input and its zero, and at the sensor's wires",
                cure=f"raise calibration.{name} in the experiment if it is the sensor's offset",
                key="calibration",
            )


def home(sampling: Sampling, homing: Homing, record: dict[str, Any]) -> None:
    """Wait until the load is wound and the shaft has come to rest.

    record: what run.json holds; the turns are added. Raises RunError after the time allowed.
    """
    start: float | None = None
    rest_since, rest_turns = 0.0, 0.0
    for samples in sampling.at_zero():
        now, turns = samples.time.item(-1), samples.theta.item(-1) / _TURN
        start = turns if start is None else start
        wound = abs(turns - start)
        sampling.tell(min(wound, homing.turns), homing.turns, "turns")
        if abs(turns - rest_turns) > _REST_TURNS:
            rest_since, rest_turns = now, turns
        if wound >= homing.turns and now - rest_since >= _REST_TIME:
            break
        if now > homing.timeout:
            restless = "; the shaft did not stand still then" if wound >= homing.turns else ""
            raise RunError(
                f"{wound:.2f} of {homing.turns:g} turns were wound in "
                f"{homing.timeout:g} s{restless}",
                cure="wind the load, hold it until the run goes on and start again, or raise "
                "homing.timeout in the experiment",
                key="homing",
            )
    sampling.rig.stop()
    record["homing"] = {"turns": rest_turns - (start or 0.0), "rate": sampling.sample_rate}


def require_law(rig: Rig, law: str) -> None:
    """Raise ConfigError unless an open device has this controller, within the rig's limits."""
    slew, cure = rig.config.limits.slew, "leave limits.slew out"
    if rig.info.law != law:
        what = f"has the controller {rig.info.law}" if rig.info.law else "has no controller"
        problem = f"{rig.info.name} {what} aboard; this experiment's is {law}"
        cure = "build the firmware with what rig export c makes of the experiment's controller"
    elif any(getattr(slew, channel) is not None for channel in CHANNELS):
        problem = "limits.slew of the rig's file would not hold for what the device itself commands"
    else:
        return
    raise ConfigError(problem, cure=f"{cure}; or write on_device: false", key="on_device")


def supervise(sampling: Sampling, log: LogWriter, aboard: Aboard) -> None:
    """Play references to the device's own torque controller, and log every sample.

    Raises DeviceError, InterlockError and IncompleteError as ``play`` does.
    """
    low, high = sampling.rig.config.limits.command.motor  # beyond zero both, as the plan wants
    largest = float(np.max(np.abs(aboard.reference)))
    scale = (largest or 1.0) / min(-low, high)  # N*m by V
    commands = np.zeros((len(aboard.reference), len(CHANNELS)))
    commands[:, 0] = aboard.reference / (scale * _ROUNDING)
    scales = itertools.cycle([scale * _ROUNDING, None])
    switches = zip(aboard.switches, scales, strict=False)
    play(sampling, log, commands, aboard.logged, switches, aboard.blend)


def play(
    sampling: Sampling,
    log: LogWriter,
    commands: FloatArray,
    beside: Sequence[FloatArray] = (),
    switches: Iterable[tuple[int, float | None]] = (),
    blend: int = 0,
) -> None:
    """Play commands (n_samples, 2) [V] and log every sample.

    beside: further columns of the log, (n_samples,) each. switches: samples from which on the
    device's own controller answers, by the reference [N*m] of a volt, or no longer (None).

    Raises DeviceError, InterlockError, and IncompleteError where too many samples are missing.
    """
    rig, n_samples = sampling.rig, len(commands)
    sampling.begin(Mode.OPEN_LOOP)
    orders, ordered = deque(switches), -1  # one at a time, the next once that has been carried out
    sent = done = 0
    while done < n_samples:
        if orders and done > ordered:
            ordered, scale = orders.popleft()
            rig.answer(ordered, blend, scale)
        room = rig.room()
        if sent < n_samples and room > 0:
            chunk = commands[sent : sent + room]
            rig.send(sent, chunk)
            sent += len(chunk)
            if done:
                sampling.timing.answered(done - 1)
        samples, trip = sampling.receive(n_samples)
        if len(samples) == 0:
            break
        columns = [column[samples.tick] for column in beside]
        done = sampling.keep(log, samples, columns, trip, n_samples)
        if np.any(samples.flags & int(Flag.UNDERFLOW)):
            raise DeviceError(
                f"the device ran out of commands by sample {done - 1} and says that it zeroed "
                "its outputs; the host was too slow to refill it"
            )
        _require_samples(sampling, log, done, n_samples)
    _require_samples(sampling, log, n_samples, n_samples)


def control(sampling: Sampling, log: LogWriter, dialogue: Dialogue, n_samples: int) -> None:
    """Answer and log every sample until the controller has ended, ``n_samples`` at the most.

    Raises DeviceError, RunError, InterlockError, and IncompleteError as ``play`` does.
    """
    rig, ahead = sampling.rig, dialogue.ahead
    if ahead > rig.info.queue:
        raise DeviceError(
            f"{rig.info.name} holds {rig.info.queue} commands, and the experiment sends its "
            f"{ahead} ticks ahead",
            cure=f"set ahead to {rig.info.queue} or less in the experiment's file",
        )
    sampling.begin(Mode.CLOSED_LOOP)
    rig.send(0, np.zeros((ahead, len(CHANNELS))))
    sent, done = ahead, 0
    while done < n_samples and not dialogue.ended:
        samples, trip = sampling.receive(n_samples)
        if len(samples) == 0:
            break
        commands, logged = dialogue.answers(samples)
        end = samples.tick.item(len(commands) - 1) + 1
        if trip is None and not dialogue.ended:
            until = end + ahead
            if until - sent != len(commands):
                # A lost sample has no answer: the one after it serves its tick too.
                ticks = np.arange(sent, until)
                commands = commands[np.searchsorted(samples.tick + ahead, ticks)]
            rig.send(sent, commands)
            sampling.timing.answered(end - 1)
            sent = until
        done = sampling.keep(log, before(samples, end), logged, trip, n_samples)
        _require_samples(sampling, log, done, n_samples)
    end = done if dialogue.ended else n_samples
    _require_samples(sampling, log, end, end)


def _require_samples(sampling: Sampling, log: LogWriter, end: int, total: int) -> None:
    """Raise IncompleteError once too many of a run's samples are missing before ``end``."""
    missing, share = end - log.n_samples, sampling.rig.config.limits.lost
    if missing > share * total:
        raise IncompleteError(
            f"{missing} of the run's {total} samples are missing by sample {end - 1}, more than "
            f"limits.lost of {share:g} allows",
            cure="look at the line ('rig doctor', connection.line in run.json), sample more "
            "slowly, or allow more in the rig's file",
        )
