"""C99 of a torque controller, for the firmware of a device: what ``rig export c`` writes."""

from dataclasses import dataclass
from pathlib import Path

from daq.errors import ConfigError
from daq.files import make_folder, write_whole
from daq.lookup.controllers import load_controller
from daq.torque import LawProgram
from sysid import ModelError
from sysid.engine.c_text import CTextError, Precision, c_name, c_text, numbers_text

_HEADER = """\
/* {what}
   Made by rig export c of {path}; {source}.
   Fixed memory, {precision} precision, no library beyond math.h. */
#ifndef RIG_CONTROLLER_H
#define RIG_CONTROLLER_H

typedef {real} rig_real;

#define RIG_CONTROLLER_FINGERPRINT "{fingerprint}" /* by which a host knows it */
#define RIG_CONTROLLER_PERIOD {period!r} /* s */
#define RIG_CONTROLLER_AHEAD {n_ahead} /* samples from a sample to its answer */

/* The controller. It answers a sample of every {period:g} s; its commands act {ahead} later.
   theta [rad], omega [rad/s], torque [N*m] at the hand's sensor, current_motor [A]: the sample.
   reference: torque that the hand is to feel [N*m]. lost: samples missing before this one.
   volts: commands of motor and brake [V]. */
typedef struct {{ rig_real s[{n_states}]; rig_real volts[2]; }} rig_controller;
void rig_controller_reset(rig_controller *controller);
void rig_controller_step(rig_controller *controller, rig_real theta, rig_real omega,
                         rig_real torque, rig_real current_motor, rig_real reference, int lost);

/* The actuator's model over the same time, at commands [V] and a hand's torque [N*m] on the shaft.
   x: {states}. */
typedef struct {{ rig_real x[{n}]; }} rig_model;
void rig_model_reset(rig_model *model);
void rig_model_step(rig_model *model, rig_real motor, rig_real brake, rig_real torque);

#endif
"""

_FUNCTIONS = """\
void rig_controller_reset(rig_controller *controller)
{{
    for (int i = 0; i < {n_states}; i++) {{
        controller->s[i] = RL(0.0);
    }}
    controller->volts[0] = controller->volts[1] = RL(0.0);
}}

void rig_controller_step(rig_controller *controller, rig_real theta, rig_real omega,
                         rig_real torque, rig_real current_motor, rig_real reference, int lost)
{{
    {entry}(theta, omega, torque, current_motor, reference, lost, controller->s, CONSTANT_VALUES,
        PARAMETERS, controller->volts);
}}

void rig_model_reset(rig_model *model)
{{
    static const real initial[{n}] = {{ {initial} }};
    for (int i = 0; i < {n}; i++) {{
        model->x[i] = initial[i];
    }}
}}

void rig_model_step(rig_model *model, rig_real motor, rig_real brake, rig_real torque)
{{
    real u[{n_inputs}] = {{ motor, brake, torque }}, hand[4] = {{ 0 }};
    real k[{n}], d_a[{n}], d_b[{n}], d_c[{n}], y[{n}], dy[{n}];
    advance(model->x, u, PARAMETERS, MATRICES, hand, {n}, {steps}, RL({time!r}), {omega}, {theta},
        {load}, k, d_a, d_b, d_c, y, dy);
}}
"""


@dataclass(frozen=True)
class DeviceCode:
    """Texts of a header and of a source that includes it."""

    header: str
    source: str

    def save(self, folder: Path, name: str) -> tuple[Path, Path]:
        """Write ``NAME.h`` and ``NAME.c``. Raises ConfigError for a folder that takes none."""
        paths = folder / f"{name}.h", folder / f"{name}.c"
        make_folder(folder)
        write_whole(paths[0], self.header)
        write_whole(paths[1], f'#include "{name}.h"\n{self.source}')
        return paths


def device_code(controller: str | Path, precision: Precision = "double") -> DeviceCode:
    """C99 of a controller's file, as rig tune made it. Raises ConfigError.

    >>> from daq.device_code import device_code
    >>> "void rig_controller_step" in device_code("simulated_controller.yaml", "single").header
    True
    """
    tuned = load_controller(str(controller), Path())
    try:
        program = tuned.control.program(tuned.model, tuned.parameters)
        text = c_text(program.text, [program.entry, "advance"], precision)
    except (CTextError, ModelError) as error:
        raise ConfigError(f"it has no C: {error}", file=str(tuned.path)) from None
    states = ", ".join(f"{s.name} [{s.unit}]" for s in tuned.model.states)
    header = _HEADER.format(
        what=f"Torque controller {tuned.control.controller}, and its actuator's model.",
        path=tuned.path.name,
        source=f"tuned to {Path(tuned.source).name}",
        precision=precision,
        real="float" if precision == "single" else "double",
        fingerprint=program.fingerprint,
        period=program.step.time,
        n_ahead=tuned.control.ahead,
        ahead=f"{tuned.control.ahead} samples" if tuned.control.ahead > 1 else "a sample",
        n_states=program.n_states,
        n=len(program.step.initial),
        states=states,
    )
    return DeviceCode(header, _source(program, text))


def _source(program: LawProgram, text: str) -> str:
    """Functions of the law and the model, their numbers, and what calls them."""
    step = program.step
    omega, theta, load = step.places
    functions = _FUNCTIONS.format(
        entry=c_name(program.entry),
        n_states=program.n_states,
        n=len(step.initial),
        n_inputs=step.n_inputs,
        initial=", ".join(f"RL({value!r})" for value in step.initial),
        steps=step.steps,
        time=step.time,
        omega=omega,
        theta=theta,
        load=load,
    )
    numbers = [
        numbers_text("real", "CONSTANT_VALUES", program.constants),
        numbers_text("real", "PARAMETERS", program.parameters),
        numbers_text("real", "MATRICES", step.matrices),
    ]
    return "\n\n".join(["#include <math.h>\n\n" + text, *numbers, functions])
