"""Experiments: what every experiment's YAML has in common, and how a protocol decides commands.

A protocol is a subclass of one of three: ``Timed``, commands known beforehand for a duration;
``OpenLoop``, commands known beforehand; ``ClosedLoop``, a controller answers every sample.
"""

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field, PrivateAttr

from daq.config.base import Section
from daq.config.metadata import Metadata
from daq.config.units import Amperes, Hertz, Seconds, Turns
from daq.findings import Chart, Findings, Heatmap, Number
from daq.hal import CHANNELS, FloatArray, Mode, Samples
from daq.progress import Watch, ignore

MOST_SAMPLES = 20_000_000


class OffsetCalibration(Section):
    """Mean of the analog inputs at zero command, taken off all later samples."""

    samples: int = Field(3200, ge=1, le=1_000_000, description="samples averaged")
    motion: Turns = Field(
        0.01, gt=0.0, description="most that the shaft may move meanwhile, being at rest"
    )
    current_motor: Amperes = Field(
        0.1, gt=0.0, description="largest offset of the motor current; more is a current that flows"
    )
    current_brake: Amperes = Field(
        0.05, gt=0.0, description="largest offset of the brake current; more is one that flows"
    )


class Homing(Section):
    """Winding of the load's cable before the run."""

    turns: Turns = Field(0.0, ge=0.0, le=1000.0, description="turns to wind; 0 skips homing")
    timeout: Seconds = Field(60.0, gt=0.0, le=3600.0, description="time allowed for it")


class SettingError(ValueError):
    """A setting that makes no run: its dotted key, and the problem with the cure.

    >>> str(SettingError("motor.hold", "0 s; a level is held for above 0 s"))
    'motor.hold: 0 s; a level is held for above 0 s'
    """

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(key, problem)
        self.key = key
        self.problem = problem

    def __str__(self) -> str:
        return f"{self.key}: {self.problem}"


@dataclass(frozen=True)
class Plan:
    """What a run will do, known before anything is energised.

    n_samples: of the run; of a closed loop the most. lowest, highest: (2,), commands [V] of motor
    and brake; of a closed loop what its controller confines itself to. commands: (n_samples, 2)
    [V], None in closed loop. references: what a controller will ask for if nothing holds it up, by
    column name, (m,) each, m at most n_samples. remarks: what else a user should know beforehand,
    a line each. steady: the samples between a rise from zero and a fall to it, of which spectra
    are stated.
    """

    n_samples: int
    lowest: FloatArray
    highest: FloatArray
    commands: FloatArray | None = None
    references: Mapping[str, FloatArray] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    steady: slice = field(default_factory=lambda: slice(None))

    @property
    def excites(self) -> bool:
        """Whether any command may be other than zero."""
        return bool(np.any(self.lowest) or np.any(self.highest))


@dataclass(frozen=True)
class FreeSetting:
    """A number that a design may choose between two ends.

    log: whether it counts by its logarithm; whole: whether it is a whole number, such as a seed.
    calm: the value towards which it excites less, if there is one.
    """

    low: float
    high: float
    log: bool = False
    whole: bool = False
    calm: float | None = None


@dataclass(frozen=True)
class Shaft:
    """What a velocity loop may do with a rig's shaft.

    speed: the rig's limit [rad/s]. endless: whether it may turn without end. torque_sensor: where
    torque is measured. torque_constant: roughly the motor's [N*m/A], None where nothing tells it.
    """

    speed: float
    endless: bool
    torque_sensor: Literal["between", "load"]
    torque_constant: float | None


@dataclass(frozen=True)
class RunFrame:
    """What runs of a design have in common: their length, rate and ranges of the commands [V].

    shaft: None where no loop may drive it.
    """

    n_samples: int
    sample_rate: float
    motor: tuple[float, float]
    brake: tuple[float, float]
    shaft: Shaft | None = None

    @property
    def seconds(self) -> float:
        """Length of a run [s]."""
        return self.n_samples / self.sample_rate

    def level(self, channel: str) -> FreeSetting:
        """A level of a channel within the range of its commands."""
        low, high = getattr(self, channel)
        return FreeSetting(low, high, calm=0.0)

    def whole(self, seconds: float) -> float:
        """The nearest time that is a whole number of samples, one at least [s]."""
        return max(1, round(seconds * self.sample_rate)) / self.sample_rate


@dataclass(frozen=True)
class Family:
    """Runs of a protocol among which a design may choose.

    free: settings by name. content: of a value for each of them the keys of an experiment's file,
    without those that all protocols have.
    """

    free: Mapping[str, FreeSetting]
    content: Callable[[Mapping[str, float]], dict[str, Any]]


class Experiment(Section, abc.ABC):
    """An experiment: common settings here, a protocol's own in its subclass.

    A protocol is registered under the entry-point group ``rig.protocols``, or named in the YAML
    as ``FILE.py:CLASS``.
    """

    mode: ClassVar[Mode]

    name: str = Field(
        "", max_length=80, description="name of the capture folder; default the file's"
    )
    protocol: str = Field(min_length=1, description="name of a protocol, or FILE.py:CLASS")
    rig: str = Field(
        "", max_length=200, description="rig file that it is for, where the command names no other"
    )
    model: str = Field(
        "",
        max_length=400,
        description="model that its runs identify, where neither command nor file names one",
    )
    sample_rate: Hertz = Field(800.0, gt=0.0, le=1e6, description="samples per second")
    calibration: OffsetCalibration = Field(OffsetCalibration(), description="offset calibration")
    homing: Homing = Field(Homing(), description="winding of the load")
    validation: dict[str, Any] = Field(
        default_factory=dict,
        description="keys that differ in the validation run of rig run --identify",
    )
    metadata: Metadata = Field(
        Metadata(), description="what to note of the run: who, on what, why; any keys"
    )
    # Where its file lies, for the names of other files in it.
    _folder: Path = PrivateAttr(default=Path())

    @classmethod
    def family(cls, frame: RunFrame) -> Family | None:
        """Runs within a frame that ``rig design`` may choose from; None: it chooses no such."""
        return None

    @abc.abstractmethod
    def plan(self) -> Plan:
        """What the run will do.

        Raises ValueError, its text beginning with the key, for settings that make no run.
        """

    def findings(self, samples: Samples, extra: Mapping[str, FloatArray]) -> Findings | None:
        """What the protocol itself concludes from its run, None for those that only excite.

        extra: the columns that its controller adds, (n,) each. Called with what was logged,
        after a run that ended early too. Raises ValueError, saying why, where nothing follows.
        """
        return None

    def describe(self) -> dict[str, Any]:
        """The experiment as resolved, for run.json.

        A protocol adds under ``excitation`` what its settings alone do not tell: what it drew at
        random, which file it played.
        """
        return self.model_dump(mode="json")

    def samples_in(self, seconds: float, key: str = "duration") -> int:
        """Samples in a run of so many seconds, the nearest whole number.

        Raises ValueError, naming the key that decides it, for a senseless number.
        """
        n_samples = round(seconds * self.sample_rate)
        if not 2 <= n_samples <= MOST_SAMPLES:
            raise SettingError(
                key,
                f"{seconds:g} s at {self.sample_rate:g} Hz makes {n_samples} samples; 2 to "
                f"{MOST_SAMPLES} are possible: change {key} or sample_rate",
            )
        return n_samples


class OpenLoop(Experiment):
    """A protocol whose commands are known beforehand; the device's clock plays them."""

    mode = Mode.OPEN_LOOP

    @abc.abstractmethod
    def waveform(self) -> FloatArray:
        """Commands of the whole run, (n_samples, 2): motor and brake [V].

        Raises ValueError, its text beginning with the key, for settings that make no waveform.
        """

    def remarks(self) -> tuple[str, ...]:
        """What else a user should know beforehand, a line each."""
        return ()

    def plan(self) -> Plan:
        """The commands and their peaks."""
        commands = _as_commands(self.waveform())
        lowest, highest = np.min(commands, axis=0), np.max(commands, axis=0)
        return Plan(len(commands), lowest, highest, commands, remarks=self.remarks())


def _as_commands(values: Any) -> FloatArray:
    """A waveform, (n_samples, 2). Raises TypeError for what is none."""
    array = np.asarray(values)
    numbers = array.dtype.kind in "fiu"
    if not numbers or array.ndim != 2 or array.shape[1] != len(CHANNELS) or len(array) < 2:
        raise TypeError(
            f"waveform() returned shape {array.shape} of {array.dtype}; expected (n_samples, 2) "
            "numbers, motor and brake in volts, two samples at least"
        )
    return array.astype(np.float64)


class Timed(OpenLoop):
    """Commands known beforehand, for as long as the file says."""

    duration: Seconds = Field(gt=0.0, le=86400.0, description="length of the excitation")

    @property
    def n_samples(self) -> int:
        """Number of samples. Raises ValueError for a senseless one."""
        return self.samples_in(self.duration)

    @property
    def times(self) -> FloatArray:
        """Time of every sample, (n_samples,) [s]. Raises ValueError for a senseless number."""
        return np.arange(self.n_samples) / self.sample_rate


class Sample(NamedTuple):
    """One sample in SI units, as ``Samples`` has them."""

    tick: int
    time: float
    current_motor: float
    current_brake: float
    torque: float
    theta: float
    omega: float
    flags: int


class Answer(NamedTuple):
    """A controller's answer to a sample: commands [V], and what it logs beside the sample.

    logged: values of its ``columns``, such as the reference that the sample was compared with.
    """

    motor: float
    brake: float
    logged: tuple[float, ...] = ()


class Controller(Protocol):
    """Decides the commands of a closed-loop run; a new one is made for each run."""

    def answer(self, sample: Sample) -> Answer | None:
        """The commands that answer a sample; None ends the run, with zero commands.

        Every sample that arrives is answered, in order; lost ones are missing. The commands are
        applied ``ahead`` ticks after the sample, and held until the next.
        """


@dataclass(frozen=True)
class TripLimits:
    """What stops a run on a rig, and clamps its commands; infinite where nothing does.

    Currents [A], speed [rad/s], torque [N*m] either way; commands from the lowest to the highest
    [V]. count: angle of one of the encoder [rad].
    """

    current_motor: float
    current_brake: float
    speed: float
    torque: float
    motor: tuple[float, float]
    brake: tuple[float, float]
    count: float


@dataclass(frozen=True)
class Evidence:
    """What trials of an experiment with plausible actuators say before it runs.

    numbers: what they came to. remarks: what else, a line each. refusal: why the experiment must
    not run; empty where nothing speaks against it.
    """

    numbers: tuple[Number, ...]
    remarks: tuple[str, ...] = ()
    refusal: str = ""


@dataclass(frozen=True)
class Aboard:
    """A loop that the device's own torque controller closes, while this computer supervises.

    law: its fingerprint. reference: torque that the hand is to feel, (n_samples,) [N*m].
    switches: samples from which on it answers, does no longer, answers again, ... blend: samples in
    which the outputs move over. logged: the columns of the experiment, (n_samples,) each.
    """

    law: str
    reference: FloatArray
    switches: tuple[int, ...]
    blend: int
    logged: tuple[FloatArray, ...]


class ClosedLoop(Experiment):
    """A protocol whose controller answers every sample with a command."""

    mode = Mode.CLOSED_LOOP
    columns: ClassVar[Mapping[str, str]] = {}
    """What its controller logs beside every sample: column names and their units."""

    ahead: int = Field(
        1, ge=1, le=20, description="ticks from a sample to the command that answers it"
    )

    def preview(self) -> Chart | Heatmap | None:
        """What ``rig check --plot`` draws where the plan has no references; None for nothing."""
        return None

    def evidence(self, limits: TripLimits, draws: int, watch: Watch = ignore) -> Evidence | None:
        """What ``draws`` simulated trials say of the run; None where none can be made.

        Raises ConfigError, and ValueError as ``plan`` does.
        """
        return None

    def aboard(self) -> Aboard | None:
        """What the device's own controller is asked for; None where this computer answers."""
        return None

    @abc.abstractmethod
    def controller(self) -> Controller:
        """A new controller for one run, before its first sample."""
