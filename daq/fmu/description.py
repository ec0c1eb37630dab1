"""The documents in a functional mock-up unit: its variables with their units, how it is built."""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from daq.config.units import base_units
from daq.provenance import software_versions
from sysid import Input, Output, Parameter, ProcessModel, State

Signal = Input | Parameter | State | Output
START = "_start"  # behind a state's name: the parameter that says where it starts
_STEP = 1e-3  # s, of the default experiment
_ABILITIES = (
    "canHandleVariableCommunicationStepSize", "canGetAndSetFMUState", "canSerializeFMUState",
)  # fmt: skip


@dataclass(frozen=True)
class Variables:
    """A model's variables with their value references; time has 0.

    parameters: values in the model's order.
    """

    model: ProcessModel
    parameters: tuple[float, ...]

    @property
    def first(self) -> dict[str, int]:
        """The first reference of each kind, by its name in the source."""
        model, first, at = self.model, {}, 1
        for kind, group in (
            ("INPUT", model.inputs),
            ("PARAMETER", model.parameters),
            ("START", model.states),
            ("OUTPUT", model.outputs),
            ("STATE", model.states),
        ):
            first[f"FIRST_{kind}"] = at
            at += len(group)
        return first

    def rows(self) -> Iterator[dict[str, str]]:
        """Attributes of each variable, in the order of the references."""
        model, first = self.model, self.first
        time = {"name": "time", "causality": "independent", "variability": "continuous"}
        yield {**time, "valueReference": "0", "unit": "s"}
        fixed = {"causality": "parameter", "variability": "fixed"}
        tunable = {"causality": "parameter", "variability": "tunable"}
        varying = {"variability": "continuous", "initial": "calculated"}
        kinds: tuple[tuple[str, Sequence[Signal], dict[str, str]], ...] = (
            ("INPUT", model.inputs, {"causality": "input", "variability": "continuous"}),
            ("PARAMETER", model.parameters, tunable),
            ("START", model.states, fixed),
            ("OUTPUT", model.outputs, {"causality": "output", **varying}),
            ("STATE", model.states, {"causality": "local", **varying}),
        )
        starts: dict[str, Sequence[float]] = {
            "INPUT": [0.0] * len(model.inputs),
            "PARAMETER": self.parameters,
            "START": model.initial_state.tolist(),
        }
        for kind, group, attributes in kinds:
            for k, signal in enumerate(group):
                if kind == "STATE" and signal.name in model.output_names:
                    continue
                name = signal.name + (START if kind == "START" else "")
                row = {
                    "name": name,
                    "valueReference": str(first[f"FIRST_{kind}"] + k),
                    **attributes,
                    "unit": signal.unit,
                }
                if signal.description:
                    row["description"] = signal.description
                if kind in starts:
                    row["start"] = repr(float(starts[kind][k]))
                yield row


def model_description(
    variables: Variables, identifier: str, token: str, generated: datetime.datetime
) -> str:
    """``modelDescription.xml`` of FMI 3.0; generated: when, with its time zone."""
    model, version = variables.model, software_versions()["hybrid-rig"]
    date = generated.astimezone(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    root = ET.Element("fmiModelDescription", fmiVersion="3.0", modelName=model.name,
                      instantiationToken=token, generationTool=f"hybrid-rig {version}",
                      generationDateAndTime=date, variableNamingConvention="flat")  # fmt: skip
    if model.description:
        root.set("description", model.description)
    simulation = ET.SubElement(root, "CoSimulation", modelIdentifier=identifier)
    for ability in _ABILITIES:
        simulation.set(ability, "true")
    rows = list(variables.rows())
    units = ET.SubElement(root, "UnitDefinitions")
    for name in sorted({row["unit"] for row in rows if row["unit"]}):
        unit = ET.SubElement(units, "Unit", name=name)
        base = base_units(name)
        if base is not None:
            factor, powers = base
            attributes = {key: str(power) for key, power in powers.items()}
            if factor != 1.0:
                attributes["factor"] = repr(factor)
            ET.SubElement(unit, "BaseUnit", attributes)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="1", stepSize=repr(_STEP))
    listed = ET.SubElement(root, "ModelVariables")
    structure = ET.SubElement(root, "ModelStructure")
    outputs = [row for row in rows if row["causality"] == "output"]
    for row in rows:
        ET.SubElement(listed, "Float64", {key: text for key, text in row.items() if text})
    for kind in ("Output", "InitialUnknown"):
        for row in outputs:
            ET.SubElement(structure, kind, valueReference=row["valueReference"])
    return _document(root)


def build_description(identifier: str) -> str:
    """``buildDescription.xml``: how the source is compiled."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    ET.SubElement(files, "SourceFile", name=f"{identifier}.c")
    return _document(root)


def _document(root: ET.Element) -> str:
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'
