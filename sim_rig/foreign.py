"""A plant of another program: an FMU for co-simulation (FMI 2.0 or 3.0), and what is what in it."""

from __future__ import annotations

import difflib
import importlib.util
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

from pydantic import Field, ValidationInfo, model_validator

from daq.config.base import Section
from daq.config.units import base_units
from daq.files import digest
from sim_rig.actuator import OUTPUTS

_VERSIONS = ("2.0", "3.0")
_REALS = ("Real", "Float64")
_UNITS = {"motor": "V", "brake": "V", **{output.name: output.unit for output in OUTPUTS}}
_MISSING = (
    "an FMU as the plant needs FMPy, which is not installed; install it with: "
    "pip install 'hybrid-rig[fmu]' (in a clone: pip install -e '.[fmu]')"
)
Link = tuple[int, float]
"""A variable's reference, and by what its value is multiplied to be in the rig's unit."""


class Inputs(Section):
    """Which of the FMU's inputs the amplifiers' voltages go to."""

    motor: str = Field("applied_voltage_motor", description="variable of the motor's voltage [V]")
    brake: str | None = Field(
        "applied_voltage_brake", description="of the brake's [V]; null without a brake"
    )


class Outputs(Section):
    """Which of the FMU's variables the sensors see; null: such a sensor reads zero."""

    theta: str = Field("theta", description="variable of the shaft's angle [rad]")
    omega: str = Field("omega", description="of its speed [rad/s]")
    torque: str | None = Field("torque", description="of the torque at the sensor [N*m]")
    current_motor: str | None = Field("current_motor", description="of the motor's current [A]")
    current_brake: str | None = Field("current_brake", description="of the brake's current [A]")


class ForeignPlant(Section):
    """An FMU for co-simulation, instead of the plant made of parts."""

    file: str = Field(min_length=1, description="the FMU, found from this file's folder")
    sha256: str | None = Field(
        None, description="of the FMU; a run writes it down, and another file is then refused"
    )
    inputs: Inputs = Field(Inputs(), description="what the voltages are called in it")
    outputs: Outputs = Field(Outputs(), description="what the sensors see is called in it")
    parameters: dict[str, float] = Field(
        default_factory=dict, description="start values that differ, by name, in its own units"
    )
    steps: int = Field(4, ge=1, le=1000, description="communication steps in a sample")

    @model_validator(mode="after")
    def _fits(self, info: ValidationInfo) -> Self:
        folder = (info.context or {}).get("folder", Path())
        path = (folder / self.file).resolve()
        description = read_description(path)
        problems = [*_links(self, description)[1], *_unknown_parameters(self, description)]
        if problems:
            raise ValueError(f"{path.name}: {'; '.join(problems)}")
        sha256 = digest(path)
        if self.sha256 not in (None, sha256):
            raise ValueError(f"{path} is another FMU than the one with sha256 {self.sha256}")
        # What a run writes down is found from any folder.
        self.__dict__.update(file=str(path), sha256=sha256)
        return self

    def links(self) -> dict[str, Link]:
        """What each input and output of the rig is in the FMU; without those that are null."""
        return _links(self, read_description(Path(self.file)))[0]


def read_description(path: Path) -> Any:
    """FMPy's description of an FMU. Raises ValueError, with a cure, for one that cannot be run."""
    if importlib.util.find_spec("fmpy") is None:
        raise ValueError(_MISSING)
    import fmpy

    if not path.is_file():
        raise ValueError(f"{path}: there is no such file; write its path from this file's folder")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path.name} is no FMU (no ZIP file); export it again")
    try:
        with path.open("rb") as file:
            with zipfile.ZipFile(file) as archive:
                root = ElementTree.fromstring(archive.read("modelDescription.xml"))
            version = root.get("fmiVersion", "no version")
            if version.startswith(_VERSIONS):
                description = fmpy.read_model_description(file, validate=False)
    except Exception as error:  # FMPy raises bare ones
        raise ValueError(f"{path.name} has no readable modelDescription.xml: {error}") from None
    if not version.startswith(_VERSIONS):
        raise ValueError(f"{path.name} is of FMI {version}; export it as FMI 2.0 or 3.0")
    if description.coSimulation is None:
        raise ValueError(
            f"{path.name} is for model exchange only, without a solver; export it for co-simulation"
        )
    _check_binary(path, description.coSimulation.modelIdentifier)
    return description


def _check_binary(path: Path, identifier: str) -> None:
    """Refuse an FMU that has nothing to run on this computer."""
    import fmpy

    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    here = {fmpy.platform, fmpy.platform_tuple}
    if any(f"binaries/{name}/{identifier}{fmpy.sharedLibraryExtension}" in names for name in here):
        return
    there = sorted({name.split("/")[1] for name in names if name.startswith("binaries/")} - {""})
    cure = f"export it for {' or '.join(sorted(here))}"
    if any(name.startswith("sources/") and name.endswith(".c") for name in names):
        cure += f", or compile the sources in it: fmpy compile {path.name}"
    raise ValueError(
        f"{path.name} has no binary for this computer "
        f"({'it has ' + ', '.join(there) if there else 'it has none at all'}); {cure}"
    )


def _links(plant: ForeignPlant, description: Any) -> tuple[dict[str, Link], list[str]]:
    variables = {v.name: v for v in description.modelVariables if v.type in _REALS}
    links, problems = {}, []
    for key, section in (("inputs", plant.inputs), ("outputs", plant.outputs)):
        for name, variable in section.model_dump().items():
            if variable is None:
                continue
            at = f"{key}.{name}"
            names = [n for n, v in variables.items() if key == "outputs" or v.causality == "input"]
            if variable not in names:
                kind = "real variable" if key == "outputs" else "real input"
                problems.append(f"{at}: there is no {kind} {variable!r}; {_near(variable, names)}")
            elif variables[variable].dimensions:
                problems.append(f"{at}: {variable!r} is an array; name a variable of one number")
            else:
                factor = _factor(variables[variable], description, _UNITS[name])
                if isinstance(factor, str):
                    problems.append(f"{at}: {factor}")
                else:
                    links[name] = variables[variable].valueReference, factor
    return links, problems


def _unknown_parameters(plant: ForeignPlant, description: Any) -> list[str]:
    names = [
        v.name for v in description.modelVariables
        if v.type in _REALS and v.causality in ("parameter", "local", "input") and v.start
    ]  # fmt: skip
    return [
        f"parameters.{name}: there is no real {name!r} that has a start value; {_near(name, names)}"
        for name in plant.parameters
        if name not in names
    ]


def _near(name: str, names: Iterable[str]) -> str:
    names = list(names)
    near = difflib.get_close_matches(name, names, 3, 0.4) or names[:8]
    return f"it has {', '.join(near)}" if near else "it has none"


def _factor(variable: Any, description: Any, unit: str) -> float | str:
    """By what a variable is multiplied to be in a unit; what is wrong where it is not of its kind.

    A variable without a unit is taken as it is. An angle has no dimension.
    """
    stated = variable.unit or getattr(variable.declaredType, "unit", None)
    if not stated:
        return 1.0
    rigs, theirs = base_units(unit), None
    for definition in description.unitDefinitions:
        base = definition.baseUnit
        if definition.name == stated and base is not None:
            if float(base.offset):
                return f"{variable.name!r} is in {stated}, which has an offset; give it in {unit}"
            powers = {name: int(getattr(base, name)) for name in ("kg", "m", "s", "A", "K", "mol")}
            theirs = float(base.factor), {name: power for name, power in powers.items() if power}
    if theirs is None:
        theirs = base_units(stated.replace(".", "*"))
    if theirs is None:
        return f"{variable.name!r} is in {stated!r}, which nothing defines; give it in {unit}"
    assert rigs is not None
    (factor, powers), wanted = theirs, {k: v for k, v in rigs[1].items() if k != "rad"}
    if {k: v for k, v in powers.items() if k != "rad"} != wanted:
        return f"{variable.name!r} is in {stated}, which is no {unit}; name another variable"
    return factor / rigs[0]
