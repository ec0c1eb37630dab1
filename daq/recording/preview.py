"""What an experiment would do, without energising anything."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.rig import RigConfig
from daq.errors import ConfigError, Mistake, RunError
from daq.experiment import ClosedLoop, Evidence, Experiment, Plan, TripLimits
from daq.files import write_whole
from daq.hal import CHANNELS, Disclosing, FloatArray
from daq.logs.columns import UNITS
from daq.notation import rounded_off
from daq.progress import Event, Note, Watch, ignore
from daq.recording.session import Session, open_session
from daq.run.protocol import evidence_of, preview_of
from daq.views import Shown

_PART = 0.9  # of the power, that the stated band holds


@dataclass(frozen=True)
class ChannelFacts:
    """What a plan does to a channel; of a closed loop only the range is known beforehand.

    Of the steady part: mean_volts; rms_volts, root mean square of the deviation from it;
    crest_factor, the largest deviation over that; power_band_hz, ends of the band that holds 90 %
    of its power, as much being below it as above; changes, samples that differ from the one
    before. A channel that is held has no crest factor and no band.
    """

    lowest_volts: float
    highest_volts: float
    limits_volts: tuple[float, float]
    mean_volts: float | None = None
    rms_volts: float | None = None
    crest_factor: float | None = None
    power_band_hz: tuple[float, float] | None = None
    changes: int | None = None


@dataclass(frozen=True, repr=False)
class Preview(Shown):
    """A session that has been checked, and what its plan does to each channel.

    evidence: what simulated trials say, where they were asked for and can be made. warnings: what a
    user must know of the rig's limits and the connection.

    >>> from daq import check
    >>> preview = check("prbs.yaml")
    >>> preview.channels["motor"].limits_volts, preview.concludes
    ((-5.0, 5.0), False)
    """

    session: Session
    channels: dict[str, ChannelFacts]
    evidence: Evidence | None = None
    warnings: tuple[str, ...] = ()

    @property
    def headline(self) -> str:
        """The experiment and how long it takes."""
        length = f"{self.seconds:.4g} s at {self.experiment.sample_rate:.4g} Hz"
        return f"{self.session.loaded.name}: {length}, within the limits"

    @property
    def experiment(self) -> Experiment:
        """The experiment, as its file has it."""
        return self.session.loaded.experiment

    @property
    def plan(self) -> Plan:
        """What the run will do."""
        return self.session.plan

    @property
    def seconds(self) -> float:
        """Duration of the run, of a closed loop the longest [s]."""
        return self.plan.n_samples / self.experiment.sample_rate

    @property
    def resolution(self) -> float:
        """Distance of the spectral lines that the run can tell apart [Hz]."""
        steady = len(range(self.plan.n_samples)[self.plan.steady])
        return self.experiment.sample_rate / steady

    @property
    def concludes(self) -> bool:
        """Whether its protocol concludes something itself, and so was not meant to excite all."""
        return type(self.experiment).findings is not Experiment.findings

    @property
    def units(self) -> dict[str, str]:
        """Units of the columns that a closed loop logs."""
        experiment = self.experiment
        return {**UNITS, **experiment.columns} if isinstance(experiment, ClosedLoop) else {}

    @property
    def caveats(self) -> list[Mistake]:
        """What the rig's device cannot promise, each with what to do about it."""
        device = self.session.device
        return device.caveats() if isinstance(device, Disclosing) else []

    @property
    def document(self) -> dict[str, Any]:
        """The same for machines."""
        plan, experiment = self.plan, self.experiment
        return {
            "protocol": experiment.protocol,
            "mode": experiment.mode.value,
            "sample_rate_hz": experiment.sample_rate,
            "samples": plan.n_samples,
            "duration_seconds": self.seconds,
            "resolution_hz": self.resolution,
            "channels": {name: asdict(facts) for name, facts in self.channels.items()},
            "references": {
                name: [float(values.min()), float(values.max())]
                for name, values in plan.references.items()
            },
            "remarks": list(plan.remarks),
            "experiment": str(self.session.loaded.file.path),
            "validation_run": self.session.validation is not None,
            "rig": self.session.rig.name,
            **({} if self.evidence is None else {"trials": _trials(self.evidence)}),
            "cannot_promise": [caveat.text for caveat in self.caveats],
            "warnings": list(self.warnings),
        }


def check(
    experiment: str | Path,
    rig: str | Path | None = None,
    port: str | None = None,
    *,
    draws: int = 0,
    watch: Watch = ignore,
) -> Preview:
    """Check an experiment against a rig, as before a run, and say what it would do.

    Files as for ``rig check``. draws: simulated trials of a torque controller's experiment, each
    with an actuator and a hand of its own. Raises ConfigError with all mistakes, and where the
    trials speak against the run.

    >>> from daq import check
    >>> check("prbs.yaml").seconds
    1.25
    """
    name, warnings = None if rig is None else str(rig), list[str]()

    def tell(event: Event) -> None:
        if isinstance(event, Note) and event.level == "warning":
            warnings.append(event.text)
        watch(event)

    session = open_session(str(experiment), name, port, watch=tell, to_run=False)
    settings = session.loaded.experiment
    channels = {name: _facts(session.plan, session.rig, settings, name) for name in CHANNELS}
    evidence = _evidence(session, draws, tell) if draws else None
    return Preview(session, channels, evidence, tuple(warnings))


def _evidence(session: Session, draws: int, watch: Watch) -> Evidence | None:
    """What trials say of a closed loop. Raises ConfigError where they speak against it."""
    experiment, rig = session.loaded.experiment, session.rig
    if not isinstance(experiment, ClosedLoop):
        return None
    evidence = evidence_of(experiment, trip_limits(rig), draws, watch)
    if evidence is not None and evidence.refusal:
        raise ConfigError(
            evidence.refusal,
            cure="ask for less, or tune the controller with lower limits or more effort",
            file=str(session.loaded.file.path),
        )
    return evidence


def trip_limits(rig: RigConfig) -> TripLimits:
    """What stops a run on a rig."""
    limits = rig.limits
    return TripLimits(
        limits.current.motor,
        limits.current.brake,
        math.inf if limits.speed is None else limits.speed,
        math.inf if limits.torque is None else limits.torque,
        limits.command.motor,
        limits.command.brake,
        abs(rig.sensors.encoder.count),
    )


def spectral_lines(column: FloatArray, sample_rate: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies [Hz] and sizes [V] of the cosines that a column's deviation is made of, (m,)."""
    deviation = column - column.mean()
    # A held channel's rounding is no excitation.
    if np.ptp(column) <= 1e-12 * np.max(np.abs(column)):
        deviation = np.zeros_like(deviation)
    sizes = np.abs(np.fft.rfft(deviation)) * 2.0 / len(column)
    if len(column) % 2 == 0:
        sizes[-1] *= 0.5
    frequency: FloatArray = np.arange(1.0, len(sizes)) * (sample_rate / len(column))
    return frequency, sizes[1:]


def _facts(planned: Plan, rig: RigConfig, settings: Experiment, name: str) -> ChannelFacts:
    index = CHANNELS.index(name)
    ends = float(planned.lowest[index]), float(planned.highest[index])
    lowest, highest = (rounded_off(volts, max(map(abs, ends))) for volts in ends)
    limits = getattr(rig.limits.command, name)
    if planned.commands is None:
        return ChannelFacts(lowest, highest, limits)
    column = planned.commands[planned.steady, index]
    mean = rounded_off(float(column.mean()), float(np.max(np.abs(column))))
    changes = int(np.count_nonzero(np.diff(column)))
    frequency, sizes = spectral_lines(column, settings.sample_rate)
    power = np.cumsum(sizes**2)
    if power[-1] == 0.0:
        return ChannelFacts(lowest, highest, limits, mean, 0.0, changes=changes)
    rms = float(column.std())
    ends = np.searchsorted(power, power[-1] * np.array([0.5 - 0.5 * _PART, 0.5 + 0.5 * _PART]))
    low, high = frequency[ends].tolist()
    peak = float(np.max(np.abs(column - mean)))
    return ChannelFacts(lowest, highest, limits, mean, rms, peak / rms, (low, high), changes)


def _trials(evidence: Evidence) -> dict[str, Any]:
    numbers = {number.name: number.value for number in evidence.numbers}
    return {**numbers, "remarks": list(evidence.remarks)}


def draw_preview(preview: Preview, path: Path) -> None:
    """Waveforms and spectra, or what a closed loop can show, in a figure at a path.

    Raises ConfigError where there is nothing to draw, or no file can be.
    """
    from daq.figures import style
    from daq.figures.findings import draw
    from daq.figures.signals import planned_commands, planned_references

    kind = style.format_of(path)
    plan, experiment = preview.plan, preview.experiment
    time = np.arange(plan.n_samples) / experiment.sample_rate
    if plan.commands is not None:
        channels = {}
        for name, column in zip(CHANNELS, plan.commands.T, strict=True):
            frequency, sizes = spectral_lines(column[plan.steady], experiment.sample_rate)
            channels[name] = column, sizes
        figure = planned_commands(time, frequency, channels)
    elif plan.references:
        m = max(map(len, plan.references.values()))
        figure = planned_references(time[:m], plan.references, preview.units)
    elif (chart := preview_of(experiment)) is not None:
        figure = draw(chart)
    else:
        raise ConfigError(
            f"--plot {path}: {experiment.protocol} says nothing beforehand "
            "of what its controller will ask for, so there is nothing to draw",
            cure="leave --plot out, or give the plan 'references' or the protocol a method "
            "'preview'",
        )
    try:
        write_whole(
            path, style.render(figure, kind), "or choose another place with --plot FILE.png"
        )
    except RunError as error:
        raise ConfigError(str(error)) from None
