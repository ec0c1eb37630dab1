"""Whether a device samples in time, in open and in closed loop, at zero command."""

import math

import numpy as np

from daq.contract import call, checked_room, checked_samples, opened
from daq.diagnose.computer import Check, Verdict
from daq.errors import ConfigError, DeviceError, RigError
from daq.hal import ANALOG_INPUTS, CHANNELS, Device, DeviceInfo, Flag, Guard, Mode
from daq.progress import Note, Progress, Watch, ignore
from daq.run.pace import Pace
from daq.run.realtime import RealTime

USUAL = 800.0  # Hz, of the shipped experiments
# Hz; most clocks can be divided down to them.
_USUAL_RATES = (4000.0, 2000.0, 1000.0, USUAL, 500.0, 200.0, 100.0)
_SPAN = 2.5  # s in each mode: as long as a timer takes to show that it is too slow
_FEW = 0.01  # of the commands
_LATE = (
    "where wake-ups below are late as well, end other programs; otherwise the way over the line "
    "and back takes too long: sample more slowly (--rate), or send further ahead (ahead in the "
    "experiment's file)"
)


def sampling_checks(device: Device, info: DeviceInfo, sample_rate: float | None) -> list[Check]:
    """Sample in open, then in closed loop, at zero command; up to the first mode that fails.

    device: open. info: what it says of itself. sample_rate [Hz]: the usual one without, or the
    fastest of a slower device. A device whose clock waits for the host has nothing to show.
    """
    if info.virtual_time:
        return []
    rate = min(USUAL, info.max_rate) if sample_rate is None else sample_rate
    checks: list[Check] = []
    realtime = RealTime()
    realtime.begin("prefer")
    try:
        for mode in Mode:
            checks.append(_sampled(device, info, mode, rate))
            if checks[-1].verdict == "bad":
                break
    finally:
        realtime.undo()
    return checks


def fastest(device: Device) -> float:
    """Samples per second that a device takes at most, as it says itself [Hz]."""
    with opened(device) as info:
        return info.max_rate


def kept_up_with(device: Device, rate: float, watch: Watch = ignore) -> float:
    """The fastest usual rate up to ``rate`` [Hz] with which device and computer keep up.

    Seconds at zero command show it in either mode, of a device that has a clock of its own. Raises
    DeviceError where they keep up with none.
    """
    slow, at_most = list[Check](), fastest(device)
    rates = sorted({rate, *_USUAL_RATES}, reverse=True)
    for tried in (each for each in rates if each <= min(rate, at_most)):
        status = f"{tried:g} Hz, outputs at zero"
        with opened(device) as info:
            if not info.virtual_time:
                watch(Progress("Sample rate", 0, 1, status))
            slow = [c for c in sampling_checks(device, info, tried) if c.verdict == "bad"]
            if not info.virtual_time:
                watch(Progress("Sample rate", 1, 1, status))
        if not slow:
            return tried
        watch(Note("note", f"{slow[0].subject}: {slow[0].observation}"))
    if slow:
        raise DeviceError(f"{slow[0].subject}: {slow[0].observation}", cure=slow[0].cure)
    raise DeviceError(f"the device samples at up to {at_most:g} Hz, no usual rate")


def _sampled(device: Device, info: DeviceInfo, mode: Mode, rate: float) -> Check:
    subject = f"{mode.value} at {rate:g} Hz"
    wanted = math.ceil(_SPAN * rate)
    try:
        came, late = _counts(device, mode, rate, wanted, info.queue)
        call(device.stop)
    except RigError as error:
        # What only the rig's file lacks, such as a phase that is measured later, is no fault.
        verdict: Verdict = "could be better" if isinstance(error, ConfigError) else "bad"
        cure = error.cure or "mend that, and ask again"
        return Check(subject, verdict, error.mistakes[0].problem, cure)
    observation = f"{came} of {wanted} samples came"
    if came < wanted:
        cure = "check cable and connectors; of a slow line raise the baud rate, or lower --rate"
        return Check(subject, "bad", observation, cure)
    if mode is Mode.OPEN_LOOP:
        return Check(subject, "good", observation)
    observation += f", {late} commands too late"
    if not late:
        return Check(subject, "good", observation)
    return Check(subject, "bad" if late > _FEW * wanted else "could be better", observation, _LATE)


def _counts(device: Device, mode: Mode, rate: float, wanted: int, queue: int) -> tuple[int, int]:
    """Of so many samples at zero command: how many came, and of how many the command was late.

    In closed loop each sample is answered by one command, the next tick's.
    """
    zero, beyond = np.zeros(len(CHANNELS)), np.full(len(ANALOG_INPUTS), math.inf)
    call(device.start, rate, mode, Guard(zero, zero, -beyond, beyond))
    pace = Pace(rate)
    ahead = 1 if mode is Mode.CLOSED_LOOP else queue
    sent, last, came, late = 0, -1, 0, 0
    while last + 1 < wanted:
        due = min(min(last + 1 + ahead, wanted) - sent, checked_room(call(device.room)))
        if due > 0:
            call(device.send, sent, np.zeros((due, len(CHANNELS))))
            sent += due
        raw = checked_samples(call(device.receive), last)
        last = raw.tick.item(-1)
        pace.received(last)
        within = raw.flags[raw.tick < wanted]
        came += len(within)
        late += int(np.count_nonzero(within & int(Flag.HELD | Flag.UNDERFLOW)))
    return came, late
