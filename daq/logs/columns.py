"""Columns of a log and their units."""

_UNITS_OF_COLUMNS = {
    # The first eight are what the lab's existing scripts read; the original program wrote no more.
    "t": "s",
    "cmd_voltage_motor": "V",
    "cmd_voltage_brake": "V",
    "current_motor": "A",
    "current_brake": "A",
    "torque": "N*m",
    "theta": "rad",
    "omega": "rad/s",
    "tick": "",
    "applied_voltage_motor": "V",
    "applied_voltage_brake": "V",
    "flags": "",
}
COLUMNS = tuple(_UNITS_OF_COLUMNS)
ORIGINAL_COLUMNS = COLUMNS[:8]
UNITS = {name: unit for name, unit in _UNITS_OF_COLUMNS.items() if unit}
# Attributes of ``Samples`` that hold the columns.
ATTRIBUTES = {name: "time" if name == "t" else name for name in COLUMNS}
