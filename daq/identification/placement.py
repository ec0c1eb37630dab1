"""Whether a run's torque sensor is where the actuator's model takes it to be."""

from collections.abc import Sequence

from daq.identification.records import LoggedRecord
from daq.logs.capture import read_record, settings_of
from daq.lookup.models import DEFAULT_MODEL
from sysid import ProcessModel
from sysid.problem.faults import DataFault, Part

_TORQUE = "torque"


def placement_faults(
    model: ProcessModel, logs: Sequence[LoggedRecord], part: Part
) -> list[DataFault]:
    """Runs whose experiment says that the sensor is between motor and brake.

    The actuator's model with a measured load takes its torque for what acts on the shaft's end.
    """
    if model.name != DEFAULT_MODEL or _TORQUE not in model.input_names:
        return []
    names = [log.dataset.name for log in logs if _is_between(log)]
    if not names:
        return []
    return [
        DataFault(
            "place",
            "doubt",
            part,
            tuple(names),
            _TORQUE,
            "its torque was measured between motor and brake ('torque_sensor' of the experiment)",
            "the model takes it for a load, and has the brake's torque twice",
            "say so and what the load was, as --model actuator:load=free,sensor=between",
            1.0,
            moves_parameters=True,
        )
    ]


def _is_between(log: LoggedRecord) -> bool:
    experiment, _ = settings_of((log.of_a_rig and read_record(log.path)) or {})
    return experiment.get("torque_sensor") == "between"
