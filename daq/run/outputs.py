"""Whether both outputs are zero at the end of a run: read back, not believed."""

import contextlib
import math
import threading
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from daq.config.rig import RigConfig
from daq.errors import DeviceError
from daq.experiment import OffsetCalibration
from daq.hal import CHANNELS, FloatArray, Mode, Samples
from daq.rig import Rig
from daq.run.sampling import at_rest

_WINDOW = 0.05  # s at zero command, of whose second half the outputs are judged
_LONGEST = 0.5  # s that a coil's current may take to decay
_DEADLINE = 5.0  # s for all of it: a device that hangs must not hold up the end of a run
_READ = [f"{what}_{channel}" for what in ("applied_voltage", "current") for channel in CHANNELS]
_SIGMAS = 4.0  # of a mean current's noise


@dataclass(frozen=True)
class OutputState:
    """What is known of the outputs after the end of a run.

    confirmed: whether both were read back as zero. problem: why they were not, or what else went
    wrong in making them so. readings: largest voltage applied [V] and mean current [A] by name.
    """

    confirmed: bool
    problem: str | None = None
    readings: dict[str, float] = field(default_factory=dict)

    @property
    def document(self) -> dict[str, Any]:
        """For run.json; without values that JSON has not."""
        readings = {name: v if math.isfinite(v) else None for name, v in self.readings.items()}
        return {"confirmed": self.confirmed, "problem": self.problem, **readings}

    @property
    def text(self) -> str:
        """The one sentence on the outputs that a message may hold."""
        if self.confirmed:
            return "both outputs are zero: read back from the device"
        return f"switch off the amplifier: zero outputs are not confirmed ({self.problem})"


INTERRUPTED = OutputState(False, "reading them back was interrupted")


def read_back(rig: Rig, sample_rate: float, calibration: OffsetCalibration) -> OutputState:
    """Sample after the outputs were zeroed; never raises but for signals."""
    states = [OutputState(False, f"the device has not answered within {_DEADLINE:g} s")]

    def work() -> None:
        try:
            states.append(_read(rig, sample_rate, calibration))
        except BaseException as error:  # no signal is raised in a thread
            states.append(OutputState(False, str(error) or type(error).__name__))

    # A thread can be left behind where a backend hangs; a signal ends the waiting for it.
    thread = threading.Thread(target=work, name="reading outputs back", daemon=True)
    thread.start()
    thread.join(_DEADLINE)
    return states[-1]


def _read(rig: Rig, sample_rate: float, calibration: OffsetCalibration) -> OutputState:
    """By the samples that follow SAFE in the run; where they fail, anew with commands of zero."""
    first = None
    if rig.sampling:
        try:
            first = _watched(rig, iter(rig.receive, None), sample_rate, calibration)
        except DeviceError as failure:
            first = OutputState(False, str(failure))
        if first.confirmed:
            return first
    try:
        anew = _sampled_anew(rig, sample_rate, calibration)
    except Exception:
        if first is None:
            raise
        return first
    if first is None or not anew.confirmed:
        return anew
    # Where SAFE did not help, zero commands may have; but SAFE is what the device is left in.
    return replace(anew, confirmed=not first.readings, problem=first.problem)


def _sampled_anew(rig: Rig, sample_rate: float, calibration: OffsetCalibration) -> OutputState:
    """Sample at zero command; on a new connection where the old one fails."""
    try:
        return _sampled(rig, sample_rate, calibration)
    except DeviceError as failure:
        try:
            with contextlib.suppress(DeviceError):
                rig.close()
            rig.open()
            rig.safe()
            state = _sampled(rig, sample_rate, calibration)
        except Exception:
            raise failure from None
        return replace(state, problem=state.problem or str(failure))


def _sampled(rig: Rig, sample_rate: float, calibration: OffsetCalibration) -> OutputState:
    rig.start(sample_rate, Mode.CLOSED_LOOP)
    return _watched(rig, at_rest(rig, sample_rate), sample_rate, calibration)


def _watched(
    rig: Rig, arriving: Iterator[Samples], sample_rate: float, calibration: OffsetCalibration
) -> OutputState:
    """The state by samples that arrive until the currents have decayed, or should have."""
    least, most = (max(2, math.ceil(span * sample_rate)) for span in (_WINDOW, _LONGEST))
    blocks: deque[Samples] = deque(maxlen=least // 2)  # enough, for none is without samples
    n_samples = 0
    state = INTERRUPTED
    while not state.confirmed and n_samples < most:
        blocks.append(next(arriving))
        n_samples += len(blocks[-1])
        if n_samples >= least:
            state = _judged(blocks, least // 2, rig, calibration)
    rig.stop()
    return state


@np.errstate(invalid="ignore", over="ignore")
def _judged(
    blocks: Collection[Samples], n_last: int, rig: Rig, calibration: OffsetCalibration
) -> OutputState:
    """The state by the last samples: voltages of zero, and currents that have decayed."""
    columns = {
        name: np.concatenate([getattr(block, name) for block in blocks])[-n_last:]
        for name in (*_READ, "omega")
    }
    readings, problems = {}, []
    for channel in CHANNELS:
        voltage, current = f"applied_voltage_{channel}", f"current_{channel}"
        readings[voltage] = float(np.abs(columns[voltage]).max())
        readings[current] = float(columns[current].mean())
        if not readings[voltage] <= rig.info.step_out:
            problems.append(f"{readings[voltage]:.3g} V are applied to the {channel}")
        largest = getattr(calibration, current) + _uncertainty(columns[current])
        if not abs(readings[current]) <= largest and not _generates(channel, columns, rig.config):
            problems.append(
                f"{current} reads {readings[current]:.3g} A at zero command, where "
                f"calibration.{current} allows {largest:.3g} A"
            )
    return OutputState(not problems, "; ".join(problems) or None, readings)


def _uncertainty(current: FloatArray) -> float:
    """Of a mean, by the noise from sample to sample, which a decay adds little to."""
    if len(current) < 3:
        return 0.0
    return _SIGMAS * float(np.diff(current).std()) / math.sqrt(2.0 * len(current))


def _generates(channel: str, columns: dict[str, FloatArray], config: RigConfig) -> bool:
    """Whether a turning motor may drive its current by itself, against its motion.

    It does on an amplifier that gives a voltage, and whose gain is therefore left out.
    """
    braking = float((columns["current_motor"] * columns["omega"]).mean()) < 0.0
    return channel == "motor" and config.amplifiers.motor is None and braking
