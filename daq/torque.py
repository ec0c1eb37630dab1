"""Torque controllers: what their settings have in common, and how one answers a sample.

A controller is a class of settings that ``rig tune`` writes into a file together with an identified
model; an experiment that names the file makes a law of it, which turns a torque for the hand into
commands. Controllers are registered under the entry-point group ``rig.controllers``.
"""

import abc
import hashlib
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from pydantic import Field

from daq.config.base import Section
from daq.config.units import Amperes, Hertz
from daq.errors import ConfigError
from daq.experiment import Sample
from daq.hal import FloatArray
from sysid import LinearModel, ProcessModel

_ENDS = (2.5, 97.5)  # %


class TorqueLaw(Protocol):
    """A controller at work; a new one is made for each run."""

    def volts(self, sample: Sample, torque: float) -> tuple[float, float]:
        """Commands of motor and brake [V] by which the hand is to feel a torque [N*m].

        Called once for every sample, in order; lost ones are missing. torque: of the shaft on the
        hand, positive forwards: the negative of what a torque sensor at the load shows.
        """


@dataclass(frozen=True)
class ModelStep:
    """The actuator's model over a sample, for ``advance`` of a law's text.

    initial: its states. steps: of equal length in ``time`` [s]. places: of omega and theta among
    the states, of the hand's torque among the inputs. matrices: 5 n^2 numbers.
    """

    initial: tuple[float, ...]
    n_inputs: int
    steps: int
    time: float
    places: tuple[int, int, int]
    matrices: tuple[float, ...]


@dataclass(frozen=True)
class LawProgram:
    """A law as a program of fixed memory, which Python, Numba and C99 run alike.

    text: plain scalar Python, constants and functions; of it ``entry`` answers a sample and
    ``slopes(x, u, p, dx)`` is the model. n_states: numbers of its memory, zero at first.
    constants, parameters: its numbers, and the model's. step: the model's.

    ``entry(theta, omega, sensed, i_m, reference, lost, s, c, p, volts)``: angle [rad], speed
    [rad/s], torque sensor [N*m] and motor current [A] of a sample, the torque that the hand is to
    feel [N*m], samples lost before this one, memory, constants and parameters; writes the
    commands of motor and brake [V].
    """

    entry: str
    text: str
    n_states: int
    constants: tuple[float, ...]
    parameters: tuple[float, ...]
    step: ModelStep

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits that tell this law, its numbers to nine digits, from others."""
        numbers = [f"{value:.9g}" for value in (*self.constants, *self.parameters)]
        return hashlib.sha256("\n".join([self.entry, self.text, *numbers]).encode()).hexdigest()[:8]


@dataclass(frozen=True)
class Fact:
    """A quantity of the actuator that a controller rests on.

    draws: (n,), the same for plausible parameters; empty where none are known.

    >>> Fact("J", 1e-4, "kg*m^2", np.linspace(0.9e-4, 1.1e-4, 101)).interval
    (9.05e-05, 0.0001095)
    """

    name: str
    value: float
    unit: str
    draws: FloatArray
    meaning: str = ""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Ends between which 95 % of the draws lie."""
        if not len(self.draws):
            return None
        low, high = np.percentile(self.draws, _ENDS)
        return float(f"{low:.5g}"), float(f"{high:.5g}")

    @property
    def ends(self) -> tuple[float, float]:
        """The same, the value among them; the value alone where no draws are known."""
        low, high = self.interval or (self.value, self.value)
        return min(low, self.value), max(high, self.value)


@dataclass(frozen=True)
class OperatingPoint:
    """A linear model of the actuator for small deviations from a state, and its shaft there.

    branch: of the hysteresis. brake_current [A]. stiffness [N*m/rad], damping [N*m*s/rad]: of the
    shaft. linear: of all states; its inputs are the commands and the hand's torque.
    """

    branch: str
    brake_current: float
    stiffness: float
    damping: float
    linear: LinearModel
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def state_space(self) -> Any:
        """The same as a ``control.StateSpace`` of python-control, signals named.

        Raises ConfigError where that is not installed.

        >>> from daq import tune
        >>> point = tune("torque.yaml", model="actuator:parameters=rig").operating_points()[0]
        >>> point.state_space().output_labels
        ['current_motor', 'current_brake', 'omega', 'theta']
        """
        try:
            import control
        except ImportError:
            cure = "install it with pip install hybrid-rig[control]"
            raise ConfigError("python-control is not installed", cure=cure) from None
        return control.ss(
            *self.linear,
            states=list(self.states),
            inputs=list(self.inputs),
            outputs=list(self.outputs),
            name=f"{self.branch} at {1e3 * self.brake_current:g} mA",
        )


class TorqueControl(Section, abc.ABC):
    """Settings of a torque controller, and how they become a law."""

    takes_torque: ClassVar[bool] = False
    """Whether it is fed the torque sensor, which then is no judge of it."""

    controller: str = Field(min_length=1, description="name of a controller, or FILE.py:CLASS")
    sample_rate: Hertz = Field(800.0, gt=0.0, le=1e6, description="of the experiments it is for")
    ahead: int = Field(
        1, ge=1, le=20, description="ticks from a sample to the command that answers it"
    )
    motor_current: Amperes = Field(
        2.0, gt=0.0, le=100.0, description="largest of the motor, either way"
    )
    brake_current: Amperes = Field(0.18, ge=0.0, le=10.0, description="largest of the brake")

    @abc.abstractmethod
    def facts(
        self, model: ProcessModel, parameters: FloatArray, draws: FloatArray
    ) -> tuple[Fact, ...]:
        """What the controller rests on, with its spread over ``draws``, (n, n_parameters).

        Raises sysid.ModelError for a model that it cannot control.
        """

    def operating_points(
        self, model: ProcessModel, parameters: FloatArray
    ) -> tuple[OperatingPoint, ...]:
        """The family of linear models that the controller has to do with; none by default."""
        return ()

    def tuned(
        self,
        model: ProcessModel,
        parameters: FloatArray,
        facts: tuple[Fact, ...],
    ) -> Self:
        """The settings as the spread of the facts allows them; see each controller.

        Raises sysid.ModelError where none are allowed.
        """
        return self

    def tuned_over(self, model: ProcessModel, parameters: FloatArray, draws: FloatArray) -> Self:
        """The settings that ``tuned`` gave, as they are best for plausible parameters.

        draws: (n, n_parameters); none where no spread is known. By default unchanged.
        """
        return self

    @abc.abstractmethod
    def most_volts(self, model: ProcessModel, parameters: FloatArray) -> tuple[float, float]:
        """Largest commands of motor, either way, and brake [V]."""

    def program(self, model: ProcessModel, parameters: FloatArray) -> LawProgram:
        """The law as a program. Raises ConfigError for a controller that has none."""
        cure = "give it a method 'program', or take feedforward, lqg, hinf or static"
        raise ConfigError(f"controller {self.controller} is Python alone", cure=cure)

    @abc.abstractmethod
    def law(self, model: ProcessModel, parameters: FloatArray) -> TorqueLaw:
        """A law for one run."""
