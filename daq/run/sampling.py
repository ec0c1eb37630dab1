"""Samples of a run, each shown to the limits before anything else is done with it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from daq.config.rig import CommandLimits
from daq.errors import DeviceError, InterlockError
from daq.hal import CHANNELS, DeviceInfo, Flag, FloatArray, Mode, Phase, Samples
from daq.limits import Limits, Trip
from daq.limits.device import Obedience
from daq.logs.writer import LogWriter
from daq.progress import Note
from daq.rig import Rig
from daq.run.pace import Pace
from daq.run.timing import Timing

_ZEROS_AHEAD = 0.05  # s of zero commands queued while waiting
_COARSEST = 0.5  # of a command's range that a step of its output may be


@dataclass(frozen=True)
class PhaseProgress:
    """What a watcher of a run is told: ``done`` of ``total`` in ``unit`` of a phase."""

    phase: Phase
    done: float
    total: float
    unit: str


Watcher = Callable[[PhaseProgress | Note], None]


def nobody(event: PhaseProgress | Note) -> None:
    """Watch nothing."""


class Sampling:
    """An open rig that is sampled phase by phase under its limits.

    phase: the one that is on. limits: that watch it. timing: how punctual the samples since
    ``begin`` were.
    """

    def __init__(self, rig: Rig, limits: Limits, sample_rate: float, watch: Watcher) -> None:
        self.rig = rig
        self.sample_rate = sample_rate
        self.phase = Phase.OPEN
        self.timing = Timing()
        self._pace: Pace | None = None
        self.limits = limits
        self._watch = watch

    def enter(self, phase: Phase, turns: float = 0.0) -> None:
        """A phase begins, homing with the ``turns`` to wind."""
        self.phase = phase
        self.rig.announce(phase, turns)

    def begin(self, mode: Mode) -> None:
        """Sample from tick 0 on, outputs at zero. Raises DeviceError for outputs too coarse."""
        _require_fine_outputs(self.rig.info, self.rig.config.limits.command)
        self.limits.begin(self.phase, self.sample_rate)
        self._pace = None if self.rig.info.virtual_time else Pace(self.sample_rate)
        self._obedience = Obedience(
            self.rig.config.limits, self.rig.info.step_out, mode, self.sample_rate
        )
        self.rig.start(self.sample_rate, mode, self.limits.window())
        self.timing = Timing()

    def at_zero(self) -> Iterator[Samples]:
        """Blocks of samples at zero command without end. Raises InterlockError."""
        self.begin(Mode.CLOSED_LOOP)
        for samples in at_rest(self.rig, self.sample_rate):
            self._keep_pace(samples)
            trip = self._check(samples)
            if trip is not None:
                self.rig.safe()
                raise InterlockError(f"interlock during {self.phase.value}: {trip[1]}")
            yield samples

    def receive(self, end: int) -> tuple[Samples, str | None]:
        """Samples before the tick ``end``, up to the first beyond a limit, and why it is.

        The device has been told SAFE by then. Without samples the last before ``end`` were lost.
        """
        arrived = self.rig.receive()
        self._keep_pace(arrived)
        self.timing.received(arrived)
        samples = before(arrived, end)
        trip = self._check(samples) if len(samples) else None
        if trip is None:
            return samples, None
        self.rig.safe()
        row, reason = trip
        samples = before(samples, samples.tick.item(row) + 1)
        flags = samples.flags.copy()
        flags[row] |= int(Flag.INTERLOCK)
        return replace(samples, flags=flags), reason

    def _check(self, samples: Samples) -> Trip | None:
        """The first row beyond a limit, or in which the device does not do as it is told."""
        trips = [self.limits.check(samples), self._obedience.check(samples)]
        return min(filter(None, trips), key=itemgetter(0), default=None)

    def _keep_pace(self, arrived: Samples) -> None:
        """Raise DeviceError for samples that are not in time with this computer's clock."""
        if self._pace is not None:
            self._pace.received(arrived.tick.item(-1))

    def keep(
        self,
        log: LogWriter,
        samples: Samples,
        extra: Sequence[FloatArray],
        trip: str | None,
        total: int,
    ) -> int:
        """Log samples of ``total``; the tick after them.

        extra: further columns, (n,) each. Raises InterlockError where there is a ``trip``.
        """
        log.append(samples, extra)
        self.timing.logged(samples)
        end = samples.tick.item(-1) + 1
        self.tell(end, total, "samples")
        if trip is not None:
            raise InterlockError(f"interlock in sample {end - 1}: {trip}")
        return end

    def tell(self, done: float, total: float, unit: str) -> None:
        """Tell the watcher how far the phase is."""
        self._say(PhaseProgress(self.phase, done, total, unit))

    def warn(self, text: str) -> None:
        """Tell the watcher what must not wait for the end of the run."""
        self._say(Note("warning", text))

    def _say(self, event: PhaseProgress | Note) -> None:
        try:
            self._watch(event)
        except OSError:
            # Its terminal or pipe is gone. That is no reason to lose a run: whoever closed it
            # ends the run by a signal, if that was meant.
            self._watch = nobody


def _require_fine_outputs(info: DeviceInfo, command: CommandLimits) -> None:
    """Raise DeviceError where a step of the outputs is no small part of a command's range."""
    for channel in CHANNELS:
        low, high = getattr(command, channel)
        if info.step_out > _COARSEST * (high - low):
            raise DeviceError(
                f"the outputs of {info.name} have steps of {info.step_out:.3g} V, and "
                f"limits.command.{channel} of the rig's file is {low:g} to {high:g} V: a command "
                "could not be told from none",
                cure="mend what the device says of its outputs (the scale in WELCOME, "
                "DeviceInfo.step_out of a backend), or give it finer ones",
            )


def at_rest(rig: Rig, sample_rate: float) -> Iterator[Samples]:
    """Blocks of samples at zero command without end, of a rig started in closed loop."""
    # Sent a little ahead: zeros are safe to hold, and the host need not hurry every tick.
    ahead = min(max(1, round(_ZEROS_AHEAD * sample_rate)), rig.info.queue)
    rig.send(0, np.zeros((ahead, len(CHANNELS))))
    sent = ahead
    while True:
        samples = rig.receive()
        yield samples
        # Behind a gap it takes several blocks: commands for ticks that are past take room too.
        missing = min(samples.tick.item(-1) + 1 + ahead - sent, rig.room())
        if missing > 0:
            rig.send(sent, np.zeros((missing, len(CHANNELS))))
            sent += missing


def before(samples: Samples, end: int) -> Samples:
    """The samples with ticks before ``end``."""
    if samples.tick.item(-1) < end:
        return samples
    kept = samples.tick < end
    return Samples(**{name: column[kept] for name, column in vars(samples).items()})
