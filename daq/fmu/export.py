"""A model with its parameters as a functional mock-up unit: what ``rig export fmu`` writes."""

from __future__ import annotations

import datetime
import hashlib
import io
import platform
import re
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from daq.errors import ConfigError, RunError
from daq.files import write_whole
from daq.fmu.description import Variables, build_description, model_description
from daq.identification.replay import read_parameters
from daq.identification.request import PARAMETERS, result_file
from sysid import ModelError, ProcessModel
from sysid.arrays import FloatArray
from sysid.engine.c_text import CTextError, c_text, numbers_text
from sysid.engine.scalar_text import ScalarEquations

TOLERANCE = 1e-10  # error of a step in parts of a state's largest value so far
_INTERFACE = Path(__file__).with_name("fmi3.c")
_LINUX = ("x86_64", "aarch64")
_COMPILER_TIME = 120.0  # s
_HEAD = """\
/* Model {name}{about}, by hybrid-rig.
   cc -std=c99 -O2 -shared -fPIC {identifier}.c -o {identifier}.so -lm */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

"""


@dataclass(frozen=True)
class MockupUnit:
    """A functional mock-up unit: its description, its source, and what that compiles to.

    binary: of ``platform``, None without a compiler. identifier: the model's name as in C.
    """

    identifier: str
    description: str
    source: str
    platform: str | None
    binary: bytes | None
    resources: dict[str, bytes]

    def archive(self) -> bytes:
        """All of it as a ZIP file."""
        files = {
            "modelDescription.xml": self.description.encode(),
            f"sources/{self.identifier}.c": self.source.encode(),
            "sources/buildDescription.xml": build_description(self.identifier).encode(),
            **{f"resources/{name}": content for name, content in self.resources.items()},
        }
        if self.binary is not None:
            files[f"binaries/{self.platform}/{self.identifier}.so"] = self.binary
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in files.items():
                file.writestr(name, content)
        return buffer.getvalue()

    def save(self, path: str | Path) -> Path:
        """Write it; its path. Raises RunError where the disk refuses."""
        write_whole(Path(path), self.archive())
        return Path(path)


def export(result: str | Path, *, trust: bool = False, compiler: str | None = "cc") -> MockupUnit:
    """The model of an identification, from its ``parameters.yaml`` or folder.

    trust: run the Python file of a model that the result names. compiler: None to leave the binary
    out. Raises ConfigError.

    >>> from daq import identify, record
    >>> folder = identify(record("prbs.yaml"), preset="thesis", generations=2).save("results")
    >>> export(folder, compiler=None).identifier
    'actuator'
    """
    path = result_file(result)
    model, values = read_parameters(path, trust)
    try:
        vector = model.vector(values)
    except ModelError as error:
        raise ConfigError(str(error), file=path) from None
    resources = {PARAMETERS: path.read_bytes()}
    return unit_of(model, vector, compiler=compiler, resources=resources)


def unit_of(
    model: ProcessModel,
    parameters: FloatArray,
    *,
    compiler: str | None = "cc",
    resources: dict[str, bytes] | None = None,
    generated: datetime.datetime | None = None,
) -> MockupUnit:
    """A model at given parameters. Raises ConfigError for equations that have no C.

    generated: the date in its description, with its time zone; None for now.

    >>> from sysid.examples import lag
    >>> unit = unit_of(lag(), lag().nominal, compiler=None)
    >>> "fmi3DoStep" in unit.source, 'causality="output"' in unit.description
    (True, True)
    """
    variables = Variables(model, tuple(map(float, parameters)))
    try:
        equations = ScalarEquations(model)
        text = f"{equations.slopes()}\n\n{equations.observe()}"
        functions = c_text(text, ["slopes", "observe"])
    except (CTextError, ModelError) as error:
        raise ConfigError(f"model {model.name} has no C: {error}") from None
    identifier = re.sub(r"\W", "_", model.name, flags=re.ASCII)
    if not identifier or identifier[0].isdigit():
        identifier = f"model_{identifier}"
    counts = {
        "N_STATES": len(model.states),
        "N_INPUTS": len(model.inputs),
        "N_PARAMETERS": len(model.parameters),
        "N_OUTPUTS": len(model.outputs),
        **variables.first,
    }
    numbers = [
        numbers_text("double", "PARAMETERS", variables.parameters or (0.0,)),
        numbers_text("double", "INITIAL", tuple(model.initial_state.tolist())),
    ]
    enum = ",\n    ".join(f"{name} = {value}" for name, value in counts.items())
    body = "\n\n".join([functions, f"enum {{\n    {enum}\n}};", *numbers])
    rest = _INTERFACE.read_text()
    token = f"{{{hashlib.sha256((body + rest).encode()).hexdigest()[:32]}}}"
    about = f" ({model.description})" if model.description else ""
    head = _HEAD.format(name=model.name, about=about.replace("*/", ""), identifier=identifier)
    constants = f'#define TOKEN "{token}"\n#define TOLERANCE {TOLERANCE!r}\n'
    source = "\n".join([head, body, "", constants, rest])
    place = platform_name()
    binary = None
    if compiler is not None and place is not None and shutil.which(compiler):
        binary = _compiled(source, compiler)
    generated = generated or datetime.datetime.now(datetime.UTC)
    description = model_description(variables, identifier, token, generated)
    return MockupUnit(identifier, description, source, place, binary, resources or {})


def platform_name() -> str | None:
    """This computer's kind as FMI names it, for those that a binary is made for."""
    on_linux = platform.system() == "Linux" and platform.machine() in _LINUX
    return f"{platform.machine()}-linux" if on_linux else None


def _compiled(source: str, compiler: str) -> bytes:
    """A shared library of a source; ConfigError with the compiler's words where it refuses."""
    with tempfile.TemporaryDirectory() as folder:
        path, library = Path(folder) / "model.c", Path(folder) / "model.so"
        path.write_text(source)
        words = [compiler, "-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        words += [str(path), "-o", str(library), "-lm"]
        try:
            run = subprocess.run(
                words, capture_output=True, text=True, timeout=_COMPILER_TIME, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RunError(f"{compiler} does not run: {error}") from None
        if run.returncode != 0:
            raise ConfigError(f"{compiler} refuses the model: {run.stderr.strip()[:500]}")
        return library.read_bytes()
