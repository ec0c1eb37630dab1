"""How logs are turned into parameters: model, search settings, foreign columns, data sheets."""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    WithJsonSchema,
    model_validator,
)

from daq.config.base import Section
from daq.config.units import (
    QUANTITY_SCHEMA,
    Hertz,
    Part,
    Percent,
    Quantity,
    Seconds,
    converted,
    factor,
    split,
)


def _ordered(ends: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
    low, high = ends
    if low is None and high is None:
        raise ValueError("a range needs at least one end; write [low, high] or [low, null]")
    if low is not None and high is not None and low >= high:
        raise ValueError(f"low end {low:g} is not below high end {high:g}; write [low, high]")
    return ends


TermShape = Literal["sign", "linear", "square", "cube", "abs", "parabola", "sine", "stribeck"]
Range = Annotated[tuple[Quantity | None, Quantity | None], AfterValidator(_ordered)]


def _start(value: Any) -> Any:
    if isinstance(value, list):
        if len(value) == 2 and all(_is_number(end) for end in value):
            low, high = _ordered((value[0], value[1]))
            return low, high
    elif value in ("first", "estimate") or _is_number(value):
        return value
    raise ValueError("it must be first, estimate, a number, or [low, high] to estimate it in")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


_START_SCHEMA = {
    "anyOf": [
        {"enum": ["first", "estimate"]},
        QUANTITY_SCHEMA,
        {"type": "array", "items": QUANTITY_SCHEMA, "minItems": 2, "maxItems": 2},
    ]
}
StartSetting = Annotated[Any, BeforeValidator(_start), WithJsonSchema(_START_SCHEMA)]
_NAMES_SCHEMA = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}
Preset = Literal["default", "thesis", "cega", "classic"]


@dataclass(frozen=True)
class Stretch:
    """A part of a log: by time [s] as the log counts it, or by rows counted from 1.

    first, last: its ends, both of which belong to it; None for those of the log.

    >>> stretch("2 s .. 5 s"), stretch("rows 100 ..")
    (Stretch(first=2.0, last=5.0, rows=False), Stretch(first=100.0, last=None, rows=True))
    """

    first: float | None
    last: float | None
    rows: bool = False


_STRETCH_CURE = "write '0 s .. 20 s' or 'rows 1 .. 1000', with an end left out for that of the log"


def stretch(value: Any) -> Stretch:
    """What ``use`` says of a log; ValueError with the cure."""
    if isinstance(value, Stretch):
        return value
    if not isinstance(value, str) or value.count("..") != 1:
        raise ValueError(_STRETCH_CURE)
    rows = value.strip().startswith("rows")
    ends = [_end(part.strip(), rows) for part in value.strip().removeprefix("rows").split("..")]
    first, last = ends
    if first is None and last is None:
        raise ValueError(_STRETCH_CURE)
    if rows and first is not None and first < 1:
        raise ValueError("rows are counted from 1")
    if first is not None and last is not None and first >= last:
        raise ValueError(f"its first end, {first:g}, is not below its last, {last:g}")
    return Stretch(first, last, rows)


def _end(text: str, rows: bool) -> float | None:
    if not text:
        return None
    try:
        number = float(int(text)) if rows else float(converted(text, "s"))
    except ValueError as error:
        problem = "" if rows or split(text) is None else f"{error}; "
        raise ValueError(f"{problem}{_STRETCH_CURE}") from None
    if not math.isfinite(number):
        raise ValueError(_STRETCH_CURE)
    return number


def _use(value: Any) -> Stretch | dict[str, Stretch] | None:
    if not isinstance(value, dict):
        return None if value is None else stretch(value)
    stretches = {}
    for name, text in value.items():
        try:
            stretches[str(name)] = stretch(text)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    return stretches


_STRETCH_SCHEMA = {"type": "string", "pattern": r"^\s*(rows)?[^.]*(\.\d[^.]*)?\s*\.\.\s*.*$"}
UseSetting = Annotated[
    Any,
    BeforeValidator(_use),
    WithJsonSchema(
        {"anyOf": [_STRETCH_SCHEMA, {"type": "object", "additionalProperties": _STRETCH_SCHEMA}]}
    ),
]


@dataclass(frozen=True)
class RunIn:
    """The beginning of what is used of a log, in seconds or rows: simulated, not compared."""

    length: float
    rows: bool = False


def _run_in(value: Any) -> RunIn | None:
    if value is None or isinstance(value, RunIn):
        return value
    rows = re.fullmatch(r"\s*(\d+)\s*rows\s*", value) if isinstance(value, str) else None
    length = float(rows[1]) if rows else converted(value, "s")
    if not _is_number(length) or length < 0.0:
        raise ValueError("write a time such as 0.5 s, or a number of rows such as 400 rows")
    return RunIn(float(length), rows is not None)


RunInSetting = Annotated[
    Any,
    BeforeValidator(_run_in),
    WithJsonSchema({"type": ["number", "string"], "minimum": 0, "unit": "s"}),
]


def _one_of(*keys: str) -> dict[str, Any]:
    """For the schema: exactly one of several keys is there."""
    return {"oneOf": [{"required": [key]} for key in keys]}


def _several(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


class TimeColumn(Section):
    """The column that holds time, or the rate of the rows in a file without one."""

    model_config = ConfigDict(json_schema_extra=_one_of("column", "sample_rate"))

    column: str | None = Field(None, min_length=1, description="name in the CSV's header")
    unit: str = Field("s", min_length=1, description="unit of the numbers")
    sample_rate: Hertz | None = Field(None, gt=0.0, description="rows per second")
    grid: Seconds | None = Field(
        None,
        gt=0.0,
        description="uneven times are rounded to multiples of this; outputs between rows count as "
        "not measured",
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.column is None) == (self.sample_rate is None):
            raise ValueError(
                "give either 'column' (a name in the CSV) or 'sample_rate' (rows per second)"
            )
        if self.grid is not None and self.column is None:
            raise ValueError("'grid' is for a column of times; leave it out")
        return self


class Column(Section):
    """Where one signal of the model comes from: a column of the CSV, or a constant."""

    model_config = ConfigDict(json_schema_extra=_one_of("column", "constant"))

    column: str | None = Field(None, min_length=1, description="name in the CSV's header")
    constant: Quantity | None = Field(None, description="value in place of a column")
    unit: str | None = Field(None, description="unit of the numbers; default the model's")
    sign: Literal[-1, 1] = Field(1, description="-1 turns the direction round")

    @model_validator(mode="before")
    @classmethod
    def _constant_with_unit(cls, given: Any) -> Any:
        quantity = split(given.get("constant")) if isinstance(given, dict) else None
        if quantity is None or given.get("unit") is not None:
            return given
        return {**given, "constant": quantity[0], "unit": quantity[1]}

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.column is None) == (self.constant is None):
            raise ValueError("give either 'column' (a name in the CSV) or 'constant' (a value)")
        return self


class Columns(Section):
    """Names, units and signs of a foreign CSV's columns, by the model's signal names."""

    time: TimeColumn = Field(description="the column of time, or the rate of the rows")
    inputs: dict[str, Column] = Field(
        default_factory=dict, description="for each input of the model"
    )
    outputs: dict[str, Column] = Field(description="for each output that counts")


class TermSetting(Section):
    """A function of one signal that is added to an equation, times a parameter of its own."""

    equation: str = Field(description="the state to whose rate it is added", examples=["omega"])
    of: str = Field(
        description="the state or input that it is a function of, or a parameter, which changes "
        "then with its own part of the equation: it is multiplied by 1 + the term",
        examples=["omega"],
    )
    shape: TermShape = Field(
        description="of z = (signal - centre) / scale: sign (in proportion where |z| < 1), linear, "
        "square (z |z|), cube, abs, parabola (z^2), sine or stribeck (sign(z) exp(-z^2))"
    )
    scale: float = Field(gt=0.0, description="in the signal's unit", examples=[0.05])
    centre: float = Field(0.0, description="in the signal's unit")
    range: tuple[float, float] = Field(
        description="where its parameter is searched, in the unit of the equation's rate",
        examples=[[-500.0, 500.0]],
    )


class ChannelErrors(Section):
    """What is fitted of a channel's errors, each with the range of its parameter."""

    gain: tuple[float, float] | None = Field(
        None, description="by which it is to be multiplied", examples=[[0.5, 2.0]]
    )
    offset: tuple[float, float] | None = Field(
        None, description="what is to be added to it, in its unit", examples=[[-0.5, 0.5]]
    )
    drift: tuple[float, float] | None = Field(
        None,
        description="what is to be added to it for every second since a log's first sample",
        examples=[[-0.01, 0.01]],
    )


class Signals(Section):
    """How a model is used where not as it declares."""

    outputs: list[str] = Field(
        default_factory=list,
        description="outputs or states of the model that count; default its own outputs",
        examples=[["current_motor", "omega"]],
    )
    initial: dict[str, StartSetting] = Field(
        default_factory=dict,
        description="where states start: first, estimate, a number, or [low, high]",
        examples=[{"omega": "first"}],
    )
    hold: dict[str, Literal["zoh", "foh", "spline"]] = Field(
        default_factory=dict,
        description="how inputs run between samples: held (zoh), linear (foh), spline",
        examples=[{"torque": "foh"}],
    )
    terms: list[TermSetting] = Field(
        default_factory=list,
        description="functions that are added to the model's equations, such as dry friction",
        examples=[
            [
                {"equation": "omega", "of": "omega", "shape": "sign"}
                | {"scale": 0.05, "range": [-500.0, 0.0]}
            ]
        ],
    )
    channels: dict[str, ChannelErrors] = Field(
        default_factory=dict,
        description="gains, offsets, drifts of inputs and outputs, fitted with the parameters",
        examples=[{"torque": {"gain": [0.5, 2.0]}}],
    )


class IdentificationConfig(Signals):
    """Settings of ``rig identify``; each may be left out."""

    model: str | None = Field(
        None, description="installed model, or FILE.py:OBJECT", examples=["actuator"]
    )
    preset: Preset = Field(
        "default", description="how the search goes; thesis: the algorithm as the thesis has it"
    )
    population: int = Field(300, ge=2, le=1_000_000, description="chromosomes per generation")
    generations: int = Field(40, ge=1, le=1_000_000, description="generations evaluated")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="one seed, one result")
    accuracy: Part = Field(
        1e-3, ge=1e-12, le=0.1, description="normalised RMS error of a simulation"
    )
    max_steps: int = Field(
        512, ge=1, le=1_000_000, description="integration steps a sample may take"
    )
    search_samples: int = Field(
        8192,
        ge=0,
        le=1_000_000_000,
        description="samples that a search of longer logs goes by before all are fitted; 0: all",
    )
    elite_percent: Percent = Field(
        0.5,
        ge=0.0,
        lt=100.0,
        description="share of the population replaced by the best (r_elite); 0: none",
    )
    ranges: dict[str, Range] = Field(
        default_factory=dict,
        description="search ranges in place of the model's, in its units or with their own",
        examples=[{"K_m": [0.1, 0.2], "L_m": ["0.2 mH", "3 mH"]}],
    )
    fixed: dict[str, Quantity] = Field(
        default_factory=dict,
        description="parameters not searched, in the model's units or with their own",
        examples=[{"R_m": 1.18}],
    )
    tied: dict[str, str] = Field(
        default_factory=dict,
        description="multiples of other parameters",
        examples=[{"R_b": "0.5 * R_m"}],
    )
    datasheet: Annotated[list[str], BeforeValidator(_several), WithJsonSchema(_NAMES_SCHEMA)] = (
        Field(
            default_factory=list,
            description="files with data-sheet values",
            examples=["motor.yaml"],
        )
    )
    given: Annotated[list[str], BeforeValidator(_several), WithJsonSchema(_NAMES_SCHEMA)] = Field(
        default_factory=list,
        description="results of earlier identifications whose parameters are kept, with their "
        "covariance",
        examples=["runs/motor/identification/parameters.yaml"],
    )
    guess: bool = Field(
        False, description="ranges from the logs themselves, where nothing else is said"
    )
    scale: dict[str, Literal["log", "linear"]] = Field(
        default_factory=dict,
        description="scales to search on in place of the model's",
        examples=[{"K_m": "log"}],
    )
    weights: dict[str, Annotated[Part, Field(ge=0.0)]] = Field(
        default_factory=dict,
        description="relative importance of the outputs",
        examples=[{"omega": 2.0}],
    )
    per_log: bool = Field(
        False, description="normalise each log by its own largest output, not by the overall one"
    )
    criterion: Literal["auto", "compensated", "innovations", "likelihood", "error"] = Field(
        "auto",
        description="what decides in the end. likelihood: errors of free runs, each output weighed "
        "by its own; compensated: the same, less what noise of measured inputs adds; innovations: "
        "errors of an extended Kalman filter for that noise; error: the mean RMSE; auto: "
        "innovations or compensated where a calibration tells that noise, else likelihood",
    )
    process_noise: dict[str, Annotated[float, Field(ge=0.0, allow_inf_nan=False)]] = Field(
        default_factory=dict,
        description="white noise that drives states, for criterion innovations: standard deviation "
        "in the state's unit over sqrt(s)",
        examples=[{"omega": 2.0}],
    )
    balance: Literal["samples", "logs"] = Field(
        "samples", description="logs count by their samples, or each alike"
    )
    hold_back: Part = Field(
        0.0, ge=0.0, lt=1.0, description="part of each log, its end, that validates"
    )
    use: UseSetting = Field(
        None,
        description="the part of each log that is used, or of logs by name",
        examples=["0 s .. 20 s", {"day1.csv": "rows 1 .. 4000"}],
    )
    merge: Annotated[list[str], BeforeValidator(_several), WithJsonSchema(_NAMES_SCHEMA)] = Field(
        default_factory=list,
        description="files with columns that a log lacks, beside it; * stands for its name",
        examples=["*_force.csv"],
    )
    delay: dict[str, Seconds] = Field(
        default_factory=dict,
        description="by how much channels of the logs come late",
        examples=[{"torque": "3 ms"}],
    )
    filtered: dict[str, Annotated[Seconds, Field(gt=0.0)]] = Field(
        default_factory=dict,
        description="time constants of filters of first order through which channels of the logs "
        "went, as a drive's; they are taken out",
        examples=[{"omega": "8 ms"}],
    )
    noise: dict[str, Annotated[Quantity, Field(gt=0.0, allow_inf_nan=False)]] = Field(
        default_factory=dict,
        description="standard deviations of the white noise with which inputs and outputs were "
        "measured, in the model's units or with their own; default as calibrated, else not known",
        examples=[{"torque": "7 mN*m"}],
    )
    averaged: dict[str, Annotated[Seconds, Field(gt=0.0, le=60.0)]] = Field(
        default_factory=dict,
        description="outputs whose samples are means over so long before them, as the difference "
        "of two positions is the mean speed between these; default as a run's log says",
        examples=[{"omega": "2 ms"}],
    )
    detrend: dict[str, Literal["constant", "linear"]] = Field(
        default_factory=dict,
        description="what is taken off channels: their mean (constant) or a straight line (linear)",
        examples=[{"torque": "linear"}],
    )
    decimate: int = Field(
        1,
        ge=1,
        le=10_000,
        description="samples of which one is left, behind a low-pass that all channels share",
        examples=[10],
    )
    run_in: RunInSetting = Field(
        None,
        description="beginning of each log that is simulated and not compared, a time or rows",
        examples=["0.5 s", "400 rows"],
    )
    robust: bool = Field(
        False,
        description="outliers, clipped and hanging samples count as not measured",
    )
    profile: list[str] = Field(
        default_factory=list,
        description="free parameters whose profile likelihood is wanted",
        examples=[["K_m"]],
    )
    columns: Columns | None = Field(
        None,
        description="how a foreign CSV's columns are meant",
        examples=[
            {
                "time": {"column": "t", "unit": "ms"},
                "inputs": {"voltage": {"column": "u", "unit": "V"}},
                "outputs": {"omega": {"column": "n", "unit": "rpm"}},
            }
        ],
    )


class DatasheetEntry(Section):
    """One parameter: a value and how exact it is, or a range, and who says so."""

    value: Quantity | None = Field(None, description="nominal value")
    tolerance: Percent | None = Field(None, gt=0.0, description="either side of the value")
    range: Range | None = Field(None, description="in place of value and tolerance")
    fixed: bool = Field(False, description="the value is exact enough not to be searched")
    unit: str | None = Field(None, min_length=1, description="of the numbers; default the model's")
    source: str = Field("", description="which data sheet, for the table of results")

    @model_validator(mode="before")
    @classmethod
    def _with_own_unit(cls, given: Any) -> Any:
        """Value or range written with a unit, as the number and a unit."""
        if not isinstance(given, dict) or given.get("unit") is not None:
            return given
        value, ends = split(given.get("value")), given.get("range")
        if value is not None:
            return {**given, "value": value[0], "unit": value[1]}
        if not isinstance(ends, list):
            return given
        quantities = [split(end) for end in ends]
        unit = next((quantity[1] for quantity in quantities if quantity is not None), None)
        if unit is None:
            return given
        numbers = [
            end if quantity is None else quantity[0] * factor(quantity[1], unit)
            for end, quantity in zip(ends, quantities, strict=True)
        ]
        return {**given, "range": numbers, "unit": unit}

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.value is None) == (self.range is None):
            raise ValueError("give either 'value' or 'range'")
        if self.value is None:
            if self.fixed or self.tolerance is not None:
                raise ValueError("a range has no tolerance and cannot be fixed; give a value")
        elif self.fixed == (self.tolerance is not None):
            raise ValueError(
                "say how exact the value is: 'tolerance: 10 %', or 'fixed: true' not to search it"
            )
        return self

    def ends(self, factor: float) -> tuple[float | None, float | None]:
        """The range, converted by a unit's factor."""
        if self.range is not None:
            low, high = self.range
        else:
            assert self.value is not None and self.tolerance is not None
            off = abs(self.value) * self.tolerance / 100.0
            low, high = self.value - off, self.value + off
        return None if low is None else factor * low, None if high is None else factor * high
