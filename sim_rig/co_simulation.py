"""Running an FMU as the plant: an instance that goes on in time, and its steps."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from daq.errors import DeviceError
from daq.hal import CHANNELS, FloatArray
from sim_rig.actuator import OUTPUTS
from sim_rig.foreign import ForeignPlant, Link, read_description

MOTION = [next(k for k, o in enumerate(OUTPUTS) if o.name == name) for name in ("theta", "omega")]
_KEPT = 3  # messages of the FMU that an error repeats
_GRAVE = 2  # status from which a message is one of an error (FMI: error)


class CoSimulation:
    """An FMU's instance: what its sensors see now, and steps in which the inputs are held.

    values: (5,), as of ``actuator.OUTPUTS``, zero where there is no such variable. Raises
    DeviceError, with the FMU's own words, where it fails.
    """

    def __init__(self, plant: ForeignPlant) -> None:
        self.name, self.steps = Path(plant.file).name, plant.steps
        self._plant = plant
        self._links = plant.links()
        self._unit: Any = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._messages: list[str] = []

    def open(self) -> None:
        """Make an instance at time zero, instead of the one before."""
        import fmpy
        from fmpy.simulation import instantiate_fmu

        self.close()
        description = read_description(Path(self._plant.file))
        self._is_second = description.fmiVersion.startswith("2")
        self._folder = tempfile.TemporaryDirectory()
        fmpy.extract(self._plant.file, self._folder.name)
        self._time = 0.0
        starts = [
            (v.valueReference, self._plant.parameters[v.name])
            for v in description.modelVariables
            if v.name in self._plant.parameters
        ]
        try:
            # FMPy goes to the library's folder and stays there when that cannot be loaded.
            with contextlib.chdir("."):
                self._unit = instantiate_fmu(
                    self._folder.name, description, "CoSimulation", logger=self._heard
                )
            if self._is_second:
                self._unit.setupExperiment(startTime=0.0)
            for reference, value in starts:
                self._set([reference], [value])
            if self._is_second:
                self._unit.enterInitializationMode()
            else:
                self._unit.enterInitializationMode(startTime=0.0)
            self._unit.exitInitializationMode()
            self._read()
        except Exception as error:
            raise self._failure("does not start", error) from None

    def step(self, volts: FloatArray, dt: float) -> None:
        """Advance by ``dt`` [s] with these voltages (2,)."""
        links = self._linked(CHANNELS)
        references = [reference for reference, _ in links.values()]
        values = [float(volts[CHANNELS.index(n)]) / factor for n, (_, factor) in links.items()]
        try:
            self._set(references, values)
            answer = self._unit.doStep(self._time, dt)
            self._time += dt
            self._read()
        except Exception as error:
            raise self._failure(f"fails at {self._time:g} s", error) from None
        if answer is not None and answer[1]:
            raise DeviceError(f"{self.name} ends its simulation at {self._time:g} s")
        if not np.isfinite(self.values).all():
            raise DeviceError(f"{self.name} gives no finite numbers at {self._time:g} s")

    def close(self) -> None:
        """End the instance and remove what was unpacked."""
        if self._unit is not None:
            try:
                self._unit.terminate()
                self._unit.freeInstance()
            except Exception:
                self._messages.append("its end failed")  # nobody waits for it any more
            self._unit = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _linked(self, names: tuple[str, ...]) -> dict[str, Link]:
        return {name: self._links[name] for name in names if name in self._links}

    def _read(self) -> None:
        links = self._linked(tuple(output.name for output in OUTPUTS))
        references = [reference for reference, _ in links.values()]
        get = self._unit.getReal if self._is_second else self._unit.getFloat64
        read = dict(zip(links, get(references), strict=True))
        self.values = np.array(
            [read[o.name] * links[o.name][1] if o.name in read else 0.0 for o in OUTPUTS]
        )

    def _set(self, references: list[int], values: list[float]) -> None:
        (self._unit.setReal if self._is_second else self._unit.setFloat64)(references, values)

    def _heard(self, *message: Any) -> None:
        """Keep what the FMU says of errors; the last part is the text, two before it the status."""
        if message[-3] >= _GRAVE and len(self._messages) < _KEPT:
            text = message[-1]
            self._messages.append(text.decode(errors="replace") if text else "")

    def _failure(self, what: str, error: Exception) -> DeviceError:
        return DeviceError(f"{self.name} {what}: {'; '.join([str(error), *self._messages])}")


class ForeignStepper:
    """Advances an FMU by samples, with the methods of ``sysid.Stepper``; it cannot go back.

    n_steps: communication steps in a sample. Its state is the shaft's angle and speed, (2,).
    """

    def __init__(self, unit: CoSimulation, rate: float) -> None:
        self.n_steps = unit.steps
        self._unit, self._dt = unit, 1.0 / (rate * unit.steps)

    def look(self) -> tuple[FloatArray, FloatArray]:
        """The state and the outputs at the next sample, (1, 2) and (1, 5); nothing moves on."""
        values = self._unit.values[np.newaxis]
        return values[:, MOTION], values.copy()

    def advance(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As ``Stepper.advance``; what the sensors see at a sample no input of it changes."""
        n = len(u) - 1
        trace, outputs = np.empty((n * self.n_steps, 2)), np.empty((n, len(OUTPUTS)))
        for k in range(n):
            outputs[k] = self._unit.values
            for step in range(self.n_steps):
                trace[k * self.n_steps + step] = self._unit.values[MOTION]
                self._unit.step(u[k], self._dt)
        x[:] = self._unit.values[MOTION]
        return trace, outputs
