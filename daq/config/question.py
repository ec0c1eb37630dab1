"""What ``rig design`` is to find out, from what, and within what."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from daq.config.base import Section
from daq.config.units import Hertz, Part, Percent, Seconds, Turns

# Where a question does not say: length of a run [s], and samples per second [Hz].
_RUN, _RATE, _RATE_OF_STRUCTURES = 1.25, 4000.0, 800.0
Targets = dict[str, Annotated[Percent, Field(gt=0.0, le=1000.0)]]


class Question(Section):
    """Settings of ``rig design``; each may be left out."""

    rig: str = Field("", max_length=200, description="rig file; default the simulated rig's")
    plant: str | None = Field(
        None,
        description="model of the whole rig, its load included, for torque and limits; default "
        "what a simulated rig is",
        examples=["actuator:load=pulley,limits=true,turns=5"],
    )
    model: str | None = Field(
        None, description="model to identify, or FILE.py:OBJECT", examples=["actuator"]
    )
    config: str | None = Field(
        None, description="settings of its identification: ranges, fixed, tied, data sheets"
    )
    parameters: str | None = Field(
        None, description="result of an earlier identification, from which the design starts"
    )
    targets: Targets = Field(
        default_factory=dict,
        description="half width of the 95 % interval that is wanted, of parameters or combinations",
        examples=[{"K_m": "1 %", "J_m + J_b": "5 %"}],
    )
    precision: Percent | None = Field(
        None, gt=0.0, le=1000.0, description="the same for all that experiments can tell"
    )
    criterion: Literal["D", "A", "E"] = Field(
        "D",
        description="without targets: information of all (D), mean variance (A), worst one (E)",
    )
    structures: dict[str, list[str | bool | Part]] | list[str] | None = Field(
        None,
        description="model structures to tell apart, in place of parameters to know: options of "
        "model and plant, each combined with each; or models by name",
        examples=[{"hysteresis": ["bouc-wen", "dahl"], "friction": ["none", "stribeck"]}],
    )
    time: Seconds = Field(10.0, gt=0.0, le=3600.0, description="logged time of all runs, at most")
    run: Seconds | None = Field(
        None, gt=0.0, le=600.0, description="length of a run; default 1.25 s, or the time if less"
    )
    sample_rate: Hertz | None = Field(
        None,
        gt=0.0,
        le=1e6,
        description="samples per second; default 4000, and 800 to tell structures apart, which "
        "takes longer to compute; rig characterise takes fewer where device or computer do not "
        "keep up",
    )
    calibration: int = Field(
        3200, ge=1, le=1_000_000, description="samples of the offset calibration before each run"
    )
    turns: Turns | None = Field(
        None,
        ge=0.0,
        le=1000.0,
        description="of the load's cable to wind before each run; default 5 where the rig has "
        "limits.winding",
    )
    protocols: list[str] = Field(
        default_factory=list,
        description="which to choose from; default all with free settings",
        examples=[["prbs", "steps"]],
    )
    noise: dict[str, Annotated[Part, Field(gt=0.0)]] = Field(
        default_factory=dict,
        description="standard deviations of what is measured, in the model's units; default what "
        "log says, or 10 mV at each analog input and, of a speed, 0.005 counts a sample beside "
        "what the instants of its edges err by",
        examples=[{"current_motor": 0.005}],
    )
    log: str | None = Field(None, description="a run whose calibration tells the noise")
    margin: Percent = Field(
        10.0, ge=0.0, lt=100.0, description="part of each limit that is kept from it"
    )
    draws: int = Field(2, ge=1, le=64, description="parameter sets over which it is averaged")
    checks: int = Field(16, ge=1, le=1024, description="parameter sets that must keep the limits")
    candidates: int = Field(96, ge=1, le=100_000, description="runs tried at random")
    generations: int = Field(8, ge=0, le=1000, description="rounds in which the best are varied")
    offspring: int = Field(16, ge=1, le=10_000, description="new runs in each")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="one seed, one result")

    @model_validator(mode="after")
    def _one_aim(self) -> Self:
        if self.targets and self.precision is not None:
            raise ValueError("give targets or precision, not both")
        return self

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.sample_rate or (_RATE if self.structures is None else _RATE_OF_STRUCTURES)

    @property
    def seconds(self) -> float:
        """Length of a run [s]."""
        return min(_RUN, self.time) if self.run is None else self.run

    @property
    def most_runs(self) -> int:
        """How many runs the time holds."""
        return int(self.time / self.seconds + 1e-9)
