"""Columns of a log and their units."""

# The first eight are what the lab's existing scripts read; the original program wrote no more.
ORIGINAL_COLUMNS = (
    "t",
    "cmd_voltage_motor",
    "cmd_voltage_brake",
    "current_motor",
    "current_brake",
    "torque",
    "theta",
    "omega",
)
COLUMNS = (*ORIGINAL_COLUMNS, "tick", "applied_voltage_motor", "applied_voltage_brake", "flags")
UNITS = {
    "t": "s",
    "cmd_voltage_motor": "V",
    "cmd_voltage_brake": "V",
    "current_motor": "A",
    "current_brake": "A",
    "torque": "N*m",
    "theta": "rad",
    "omega": "rad/s",
    "applied_voltage_motor": "V",
    "applied_voltage_brake": "V",
}
# Attributes of ``Samples`` that hold the columns.
ATTRIBUTES = {name: "time" if name == "t" else name for name in COLUMNS}
