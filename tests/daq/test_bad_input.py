"""Every mistake a user can make at the command line: what it says, and that nothing was done.

Each case is one wrong file or argument. All of them must end with status 2, name the file, the
line and the key, say what to do, show no traceback, and leave no folder behind.
"""

import json
import os
import sys
from dataclasses import dataclass, field

import pytest

from tests.daq.support import forked_rig, rig
from tests.daq.test_log import original_text

EXPERIMENT = """\
protocol: prbs
sample_rate: 800
duration: 0.5
calibration: {samples: 16}
motor:
  amplitude: 0.75
  offset: 0.1
  minimum_period: 0.005
  seed: 4
brake:
  amplitude: 0.07
  offset: 0.07
  minimum_period: 0.05
  seed: 5
"""
RIG = """\
name: bench
backend: simulated
options:
  seed: 3
sensors:
  torque: {scale: 0.706}
limits:
  command:
    brake: [0.0, 0.38]
"""
IDENTIFICATION = """\
population: 20
generations: 2
ranges:
  K_m: [0.1, 0.2]
"""
MODEL = """\
from sysid import Input, Output, Parameter, ProcessModel, State


def derivative(x, u, p):
    return ((u[0] - x[0]) / p[0],)


model = ProcessModel(
    name="lag",
    description="a first-order lag",
    states=(State("y", "m"),),
    inputs=(Input("u", "m"),),
    outputs=(Output("y", "m"),),
    parameters=(Parameter("tau", "s", 0.1, 0.01, 1.0, "log"),),
    derivative=derivative,
)
"""


@dataclass
class Case:
    """A command in a folder of good files with ``files`` laid over them, and what it must say."""

    name: str
    args: list
    said: list
    files: dict = field(default_factory=dict)
    kept: tuple = ()


def experiment(name, old, new, *said, command="run"):
    assert EXPERIMENT.count(old) >= 1, old
    return Case(name, [command, "e.yaml"], list(said), {"e.yaml": EXPERIMENT.replace(old, new, 1)})


def rig_file(name, old, new, *said):
    assert old in RIG, old
    files = {"rig.yaml": RIG.replace(old, new, 1)}
    return Case(name, ["run", "e.yaml", "--rig", "rig.yaml"], list(said), files)


def settings(name, text, *said, args=()):
    command = ["identify", "log.csv", "--config", "id.yaml", *args]
    return Case(name, command, list(said), {"id.yaml": text})


def datasheet(name, text, *said):
    command = ["identify", "log.csv", "--datasheet", "sheet.yaml"]
    return Case(name, command, list(said), {"sheet.yaml": text})


def log(name, text, *said):
    return Case(name, ["identify", "log.csv"], list(said), {"log.csv": text})


def model(name, text, *said, of="model.py:model"):
    return Case(name, ["models", of], list(said), {"model.py": text})


COLUMNS = """\
model: model.py:model
columns:
  time: {column: t}
  inputs:
    u: {column: cmd_voltage_motor}
  outputs:
    y: {column: theta}
"""

ROWS = "t,cmd_voltage_motor,theta\n"


def foreign_log(name, rows, *said):
    """A log of rows for the columns of ``id.yaml``."""
    files = {"id.yaml": COLUMNS, "log.csv": ROWS + "".join(f"{row}\n" for row in rows)}
    return Case(name, ["identify", "log.csv", "--config", "id.yaml"], list(said), files)


ALIASES = "a0: &a0 [0]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 9)
)
CASES = [
    # --- experiments
    experiment("unknown protocol", "prbs", "prbx", "e.yaml:1:1: protocol: unknown protocol 'prbx'",
               "did you mean 'prbs'?"),
    experiment("no protocol", "protocol: prbs", "name: x", "e.yaml:1:1: protocol:",
               "for example 'protocol: prbs'"),
    experiment("misspelt key", "duration", "duratoin", "e.yaml:3:1: duratoin: unknown key",
               "did you mean 'duration'?"),
    experiment("misspelt nested key", "  offset: 0.1", "  ofset: 0.1",
               "e.yaml:7:3: motor.ofset: unknown key; did you mean 'offset'?"),
    experiment("out of range", "seed: 4", "seed: 70000",
               "e.yaml:9:3: motor.seed: it must be at most 65535, found 70000"),
    experiment("seed zero", "seed: 4", "seed: 0",
               "e.yaml:9:3: motor.seed: it must be at least 1, found 0"),
    experiment("text for a number", "duration: 0.5", "duration: long",
               "e.yaml:3:1: duration: expected a number, found 'long'", "[s]"),
    experiment("a fraction for a whole number", "seed: 4", "seed: 4.5",
               "e.yaml:9:3: motor.seed: expected a whole number, found 4.5"),
    experiment("yes for a number", "duration: 0.5", "duration: yes",
               "e.yaml:3:1: duration: expected a number; YAML reads yes, no"),
    experiment("a number for a section", "calibration: {samples: 16}", "calibration: 16",
               "e.yaml:4:1: calibration: expected 'key: value' lines, found 16"),
    experiment("an empty section", "calibration: {samples: 16}", "calibration:",
               "e.yaml:4:1: calibration: expected 'key: value' lines, found nothing"),
    experiment("negative sample rate", "800", "-800",
               "e.yaml:2:1: sample_rate: it must be above 0, found -800"),
    experiment("zero sample rate", "800", "0",
               "e.yaml:2:1: sample_rate: it must be above 0, found 0"),
    experiment("infinite duration", "duration: 0.5", "duration: .inf",
               "e.yaml:3:1: duration: expected a finite number, found .inf"),
    experiment("duration that is no number", "duration: 0.5", "duration: .nan",
               "e.yaml:3:1: duration: expected a finite number, found .nan"),
    experiment("a period of no whole samples", "0.005", "0.0051",
               "e.yaml:8:3: motor.minimum_period: 0.0051 s is 4.08 samples at 800 Hz",
               "nearest that are: 0.005 or 0.00625 s"),
    experiment("a plan beyond the limits", "amplitude: 0.07", "amplitude: 0.5",
               "e.yaml:10:1: brake: the plan asks for 0.57 V in sample 0", "limits [0, 0.38] V",
               "change amplitude or offset"),
    experiment("too short a run", "duration: 0.5", "duration: 0.0001",
               "e.yaml:3:1: duration: 0.0001 s at 800 Hz makes 0 samples; 2 to"),
    experiment("a validation run with a misspelt key", "  seed: 5",
               "  seed: 5\nvalidation:\n  motor: {sead: 3}",
               "e.yaml:16:11: validation.motor.sead: unknown key; did you mean 'seed'?",
               command="check"),
    experiment("aliases without end", "motor:", f"{ALIASES}motor:",
               "e.yaml:10:40: aliases (*name) make more than 100000 keys and values of it"),
    experiment("two documents", "motor:", "---\nmotor:", "a second document begins with '---'"),
    Case("a rig for an experiment", ["check", "rig.yaml"],
         ["rig.yaml:2:1: this file holds a rig, and should hold an experiment; give it with"]),
    Case("almost the name of a file", ["check", "prsb.yaml"],
         ["prsb.yaml: there is no such file; did you mean 'prbs.yaml'?"]),
    experiment("no YAML", "motor:", "motor: [", "e.yaml:7:9: not valid YAML",
               "a bracket opened in line 5 is not closed"),
    experiment("a quote without end", "motor:", 'motor: "', "not valid YAML",
               "a quote opened in line 5 is not closed"),
    experiment("a tab", "  amplitude: 0.75", "\tamplitude: 0.75",
               "e.yaml:6:1: not valid YAML: this line begins with a tab; indent with spaces"),
    experiment("tabs", "  amplitude: 0.75\n  offset", "\tamplitude: 0.75\n\toffset",
               "e.yaml:6:1: not valid YAML: lines 6, 7 begin with a tab; indent with spaces"),
    experiment("a line indented too far", "  offset: 0.1", "    offset: 0.1",
               "e.yaml:7:11: not valid YAML", "or a line indented too far; check the indentation"),
    experiment("a key without a colon", "duration: 0.5", "duration", "not valid YAML",
               "write 'key: value', with a space behind the colon"),
    experiment("a value of another unit", "duration: 0.5", "duration: 0.5 V",
               "e.yaml:3:1: duration: 'V' does not convert to 's'; found '0.5 V' (length"),
    experiment("a value of a unit that is none", "duration: 0.5", "duration: 0.5 parrots",
               "e.yaml:3:1: duration: unit 'parrots' is not understood; write it as in 'mm/s'"),
    experiment("a quantity beyond a bound", "duration: 0.5", "duration: 9000 min",
               "e.yaml:3:1: duration: it must be at most 86400, found '9000 min' (length", "[s])"),
    experiment("a unit for a count", "seed: 4", "seed: 4 V",
               "e.yaml:9:3: motor.seed: expected a whole number, found '4 V'; this one takes no"),
    experiment("a decimal comma", "0.75", "0,75",
               "e.yaml:6:3: motor.amplitude: expected a number, found '0,75'; write a decimal"),
    experiment("a decimal comma between braces", "calibration: {samples: 16}",
               "homing: {turns: 2,5}",
               "e.yaml:4:19: homing.5: unknown key; between braces a comma begins the next key"),
    experiment("a key of a section at the top", "sample_rate: 800", "amplitude: 800",
               "e.yaml:2:1: amplitude: unknown key; it belongs under motor or brake"),
    experiment("a key of the top in a section", "  offset: 0.1", "  duration: 0.1",
               "e.yaml:7:3: motor.duration: unknown key; it belongs at the left margin"),
    experiment("a missing key in a section", "  seed: 4\n", "",
               "e.yaml:5:1: motor.seed: this key is missing; add it (first content of the"),
    experiment("a list for a section", "{samples: 16}", "[16]",
               "e.yaml:4:1: calibration: expected 'key: value' lines, found [16]; write its keys"),
    experiment("duplicate key", "  offset: 0.1", "  amplitude: 0.1",
               "e.yaml:7:3: motor.amplitude: this key stands twice, first in line 6; keep one"),
    experiment("a number for a key", "sample_rate: 800", "1: 800", "e.yaml:2:1: 1: unknown key"),
    experiment("an alias inside its own anchor", "motor:", "motor: &m\n  again: *m",
               "e.yaml:6:10: alias *m stands inside its own anchor &m; write out what is meant"),
    experiment("a control character", "0.75", "0.75\x01",
               "e.yaml:6: not text: it holds a control character (byte 1)"),
    experiment("a date that is none", "0.75", "2024-13-45",
               "e.yaml:6:14: not valid YAML: this is no date; put text in quotes"),
    Case("missing experiment", ["run", "absent.yaml"],
         ["absent.yaml: there is no such file; check its name, or use a shipped one: ",
          "prbs.yaml"]),
    Case("an empty experiment", ["run", "e.yaml"],
         ["e.yaml: the file is empty; it must hold 'key: value' lines"], {"e.yaml": ""}),
    Case("a list for an experiment", ["run", "e.yaml"],
         ["e.yaml:1:1: expected 'key: value' lines, found a list"], {"e.yaml": "- a\n- b\n"}),
    Case("a folder for an experiment", ["run", "folder"],
         ["folder: no design was written there; name an experiment's file, or a folder that rig"]),
    Case("binary for an experiment", ["run", "e.yaml"],
         ["e.yaml:1: not text in UTF-8; save the file with this encoding"],
         {"e.yaml": b"\xff\xfe\x00p"}),
    Case("no experiment", ["run"], ["EXPERIMENT.yaml", "--help"]),
    Case("an unknown option", ["run", "e.yaml", "--identfy"], ["--identfy", "--identify"]),
    Case("captures below a file", ["run", "e.yaml", "--out", "rig.yaml"],
         ["rig.yaml: this is a file; choose a folder with --out"]),
    *[Case("captures where nothing can be made", ["run", "e.yaml", "--out", "/proc/none"],
           ["/proc/none", "cannot be created", "--out"])] * (sys.platform != "win32"),
    # --- rigs
    rig_file("unknown backend", "simulated", "serail",
             "rig.yaml:2:1: backend: unknown backend 'serail'; did you mean 'serial'?"),
    rig_file("misspelt option", "  seed: 3", "  sed: 3",
             "rig.yaml:4:3: options.sed: unknown key; did you mean 'seed'?"),
    rig_file("a value of the plant in a unit of another kind", "  seed: 3",
             "  plant: {parameters: {R_m: 1 V}}",
             "rig.yaml:4:11: options.plant.parameters: 'V' does not convert to 'ohm'"),
    rig_file("misspelt sensor", "torque", "troque",
             "rig.yaml:6:3: sensors.troque: unknown key; did you mean 'torque'?"),
    rig_file("scale of a sensor", "0.706", "none",
             "rig.yaml:6:12: sensors.torque.scale: expected a number, found 'none'"),
    rig_file("limits the wrong way round", "[0.0, 0.38]", "[0.38, 0.0]",
             "rig.yaml:9:5: limits.command.brake: low end 0.38 is not below high end 0"),
    rig_file("limits without zero", "[0.0, 0.38]", "[0.1, 0.38]",
             "rig.yaml:9:5: limits.command.brake: the range must include 0 V"),
    rig_file("one limit", "[0.0, 0.38]", "[0.38]",
             "rig.yaml:9:5: limits.command.brake: expected two values [low, high], found [0.38]"),
    rig_file("three limits", "[0.0, 0.38]", "[0, 1, 2]",
             "rig.yaml:9:5: limits.command.brake: expected two values [low, high]"),
    rig_file("a number for limits", "[0.0, 0.38]", "0.38",
             "rig.yaml:9:5: limits.command.brake: expected two values [low, high], found 0.38"),
    rig_file("an infinite limit", "[0.0, 0.38]", "[0.0, .inf]",
             "rig.yaml:9:18: limits.command.brake.1: expected a finite number, found .inf"),
    rig_file("a sign of two", "{scale: 0.706}", "{scale: 0.706, sign: 2}",
             "rig.yaml:6:26: sensors.torque.sign: it must be -1 or 1, found 2"),
    Case("missing rig", ["run", "e.yaml", "--rig", "absent.yaml"],
         ["absent.yaml: there is no such file; check its name, or use a shipped one: free_shaft"]),
    # --- identification
    settings("misspelt setting", "populaton: 20\n",
             "id.yaml:1:1: populaton: unknown key; did you mean 'population'?"),
    settings("columns by their names alone",
             "columns:\n  time: t\n  outputs: {omega: speed}\n",
             "id.yaml:2:3: columns.time: expected 'key: value' lines, found 't'; write {column: t}",
             "id.yaml:3:13: columns.outputs.omega: expected 'key: value' lines, found 'speed'"),
    settings("a range the wrong way round", IDENTIFICATION.replace("[0.1, 0.2]", "[0.2, 0.1]"),
             "id.yaml:4:3: ranges.K_m: low end 0.2 is not below high end 0.1; write [low, high]"),
    settings("a range in a unit of another kind",
             "ranges: {L_m: [0.2 mH, 3 mV]}\nfixed: {R_m: 1 A}\n",
             "id.yaml:1:10: ranges.L_m: 'mV' does not convert to 'H'; found ['0.2 mH', '3 mV']",
             "id.yaml:2:9: fixed.R_m: 'A' does not convert to 'ohm'; found '1 A'"),
    settings("an unknown parameter", IDENTIFICATION.replace("K_m", "K_n"),
             "id.yaml:4:3: ranges.K_n: model actuator has no such name; did you mean"),
    settings("an infinite range", IDENTIFICATION.replace("0.2]", ".inf]"),
             "id.yaml:4:14: ranges.K_m.1: expected a finite number, found .inf"),
    settings("a guess from a model that cannot", COLUMNS + "guess: true\n",
             "id.yaml:8:1: guess: model lag has no 'guesses' function"),
    Case("a missing data sheet", ["identify", "log.csv", "--datasheet", "absent.yaml"],
         ["absent.yaml: there is no such file"]),
    datasheet("an unknown parameter in a data sheet", "R_n: {value: 1, tolerance: 5}\n",
              "sheet.yaml:1:1: R_n: model actuator has no such parameter; did you mean 'R_m'?"),
    datasheet("a value without tolerance", "R_m: {value: 1.18}\n",
              "sheet.yaml:1:1: R_m: say how exact the value is: 'tolerance: 10 %', or 'fixed"),
    datasheet("a value and a range", "R_m: {value: 1.18, range: [1, 2]}\n",
              "sheet.yaml:1:1: R_m: give either 'value' or 'range'"),
    datasheet("a fixed range", "R_m: {range: [1, 2], fixed: true}\n",
              "sheet.yaml:1:1: R_m: a range has no tolerance and cannot be fixed"),
    datasheet("a tolerance of nothing", "R_m: {value: 1.18, tolerance: 0 %}\n",
              "sheet.yaml:1:20: R_m.tolerance: it must be above 0"),
    datasheet("a tolerance in words", "R_m: {value: 1.18, tolerance: small}\n",
              "sheet.yaml:1:20: R_m.tolerance: expected a number, found 'small'"),
    datasheet("a misspelt key of a data sheet", "R_m: {valu: 1.18, tolerance: 5 %}\n",
              "sheet.yaml:1:7: R_m.valu: unknown key; did you mean 'value'?"),
    datasheet("a unit of another kind in a data sheet", "R_m: {value: 1, fixed: yes, unit: mH}\n",
              "sheet.yaml:1:29: R_m.unit: 'mH' does not convert to 'ohm'"),
    datasheet("a value in a unit of another kind", "R_m: {value: 1 V, fixed: yes}\n",
              "sheet.yaml:1:1: R_m.unit: 'V' does not convert to 'ohm'"),
    datasheet("a physically impossible data sheet", "R_m: {range: [-1, 2]}\n",
              "sheet.yaml:1:1: R_m: parameter R_m: range [-1, 2] leaves what is physically"),
    datasheet("a number for an entry", "R_m: 1.18\n",
              "sheet.yaml:1:1: R_m: expected 'key: value' lines, found 1.18"),
    Case("the same in two data sheets", ["identify", "log.csv", "--datasheet", "sheet.yaml",
                                         "--datasheet", "other.yaml"],
         ["other.yaml:1:1: R_m: also in sheet.yaml:1:1; keep one"],
         {"sheet.yaml": "R_m: {value: 1, fixed: true}\n",
          "other.yaml": "R_m: {value: 2, fixed: true}\n"}),
    settings("a balance that is none", "balance: runs\n",
             "id.yaml:1:1: balance: it must be 'samples' or 'logs', found 'runs'"),
    settings("all held back", "hold_back: 1\n",
             "id.yaml:1:1: hold_back: it must be below 1, found 1"),
    Case("less than nothing held back", ["identify", "log.csv", "--hold-back", "-0.2"],
         ["--hold-back: it must be at least 0, found -0.2"]),
    Case("too little held back", ["identify", "log.csv", "--hold-back", "0.1"],
         ["log.csv: with hold_back 0.1 the last 10 % of it hold", "hold back another part"]),
    settings("an output of nothing", "outputs: [omga]\n",
             "id.yaml:1:1: outputs: model actuator has no output or state 'omga'; it has"),
    settings("an output twice", "outputs: [omega, omega]\n",
             "id.yaml:1:1: outputs: model actuator: outputs repeat the name 'omega'"),
    settings("one output that is no list", "outputs: omega\n",
             "id.yaml:1:1: outputs: expected a list [a, b], found 'omega'"),
    settings("a weight of an output that does not count",
             "outputs: [omega]\nweights: {current_motor: 2}\n",
             "id.yaml:2:11: weights.current_motor: model actuator has no such name; known are"),
    settings("values, names, units and ties that are wrong, all at once",
             "fixed: {R_m: -5, K_nix: 3}\nranges: {J_m: [1 V, 2 V]}\nweights: {omegga: 2}\n"
             "initial: {zz: 0.1}\ntied: {c1: c0 * unknown}\nprofile: [nonsense]\n",
             "id.yaml:1:9: fixed.R_m: -5 is outside the physical limits of R_m, 0 .. inf ohm",
             "id.yaml:1:18: fixed.K_nix: model actuator has no such name; did you mean 'K_v2i'?",
             "id.yaml:2:10: ranges.J_m: 'V' does not convert to 'kg*m^2'",
             "id.yaml:3:11: weights.omegga: model actuator has no such name; did you mean 'omega'",
             "id.yaml:4:11: initial.zz: model actuator has no such name",
             "id.yaml:5:8: tied.c1: parameter c1: 'c0 * unknown' is no multiple of another",
             "id.yaml:6:1: profile: nonsense: model actuator has no such name"),
    settings("values that are wrong beside keys that nobody knows",
             "fixed: {R_m: -5}\npopulaton: 9\nranges: {L_m: [5, 1]}\n",
             "id.yaml:1:9: fixed.R_m: -5 is outside the physical limits of R_m, 0 .. inf ohm",
             "id.yaml:2:1: populaton: unknown key",
             "id.yaml:3:10: ranges.L_m: low end 5 is not below high end 1"),
    settings("additions, channels, data sheets and results of before that are wrong, all at once",
             "terms: [{equation: omega, of: omgea, scale: 1, shape: sign, range: [-1, 1]}]\n"
             "channels: {lod: {gain: [0.5, 2]}, trque: {gain: [0.5, 2]}}\n"
             "delay: {torqe: 3 ms}\ndetrend: {omga: linear}\ndatasheet: nix.yaml\n"
             "given: nowhere\nfixed: {R_x: 1, R_m: -5}\nranges: {gain_of_lod: [0.5, 2]}\n",
             "id.yaml:1:9: terms.0: ",
             "id.yaml:2:12: channels.lod: model actuator has no channel 'lod'",
             "id.yaml:2:35: channels.trque: model actuator has no channel 'trque'",
             "id.yaml:3:9: delay.torqe: the model has no such channel",
             "id.yaml:4:11: detrend.omga: the model has no such channel",
             "nix.yaml: there is no such file", "nowhere: ",
             "id.yaml:7:9: fixed.R_x: model actuator has no such name",
             "id.yaml:7:17: fixed.R_m: -5 is outside the physical limits of R_m"),
    settings("names beside a key that is wrong", "populaton: 9\nweights: {omegga: 2}\n",
             "id.yaml:1:1: populaton: unknown key; did you mean 'population'?",
             "id.yaml:2:11: weights.omegga: model actuator has no such name"),
    settings("a start of nothing", "initial: {omga: 0}\n",
             "id.yaml:1:11: initial.omga: model actuator has no such name; did you mean 'omega'?"),
    settings("a start that is none", "initial: {omega: last}\n",
             "id.yaml:1:11: initial.omega: it must be first, estimate, a number, or [low, high]",
             "found 'last'"),
    settings("a start that is yes", "initial: {omega: yes}\n",
             "id.yaml:1:11: initial.omega: it must be first, estimate"),
    settings("starts the wrong way round", "initial: {omega: [2, 1]}\n",
             "id.yaml:1:11: initial.omega: low end 2 is not below high end 1"),
    settings("a first sample of what is not measured", "initial: {theta: first}\n",
             "id.yaml:1:11: initial.theta: state theta of model actuator is no output",
             "give a value, 'estimate' or [low, high]"),
    settings("an estimate of what is not measured", "initial: {theta: estimate}\n",
             "id.yaml:1:11: initial.theta: state theta of model actuator is no output and has no"),
    settings("a hold of nothing", "hold: {troque: zoh}\n",
             "id.yaml:1:8: hold.troque: model actuator has no such name; did you mean 'torque'?"),
    settings("a hold that is none", "hold: {torque: soh}\n",
             "id.yaml:1:8: hold.torque: it must be 'zoh', 'foh' or 'spline', found 'soh'"),
    settings("a range without ends", IDENTIFICATION.replace("[0.1, 0.2]", "[null, null]"),
             "id.yaml:4:3: ranges.K_m: a range needs at least one end; write [low, high] or"),
    settings("a one-sided range beyond what is possible",
             IDENTIFICATION.replace("[0.1, 0.2]", "[null, -1]"),
             "id.yaml:4:3: ranges.K_m: parameter K_m: range", "physically possible"),
    settings("a tie to nothing", "tied: {R_b: R_n}\n",
             "id.yaml:1:8: tied.R_b: model actuator has no parameter 'R_n'; it has"),
    settings("a tie of nothing", "tied: {R_n: R_b}\n",
             "id.yaml:1:8: tied.R_n: model actuator has no such name; did you mean"),
    settings("a tie that is no multiple", "tied: {R_b: R_m + 1}\n",
             "id.yaml:1:8: tied.R_b: parameter R_b: 'R_m + 1' is no multiple", "'0.5 * R_m'"),
    settings("a number for a tie", "tied: {R_b: 3}\n",
             "id.yaml:1:8: tied.R_b: expected text, found 3"),
    settings("ties in a circle", "tied:\n  R_b: R_m\n  R_m: 2 * R_b\n",
             "id.yaml:1:1: tied: parameter R_b: tied in a circle, R_b -> R_m -> R_b"),
    settings("a tie of a fixed parameter", "tied: {R_b: R_m}\nfixed: {R_b: 3}\n",
             "id.yaml:1:1: tied: parameter R_b has a fixed value but is tied", "keep one"),
    settings("a scale that is none", "scale: {R_m: lin}\n",
             "id.yaml:1:9: scale.R_m: it must be 'log' or 'linear', found 'lin'"),
    settings("a scale of a fixed parameter", "scale: {n_c: log}\n",
             "id.yaml:1:9: scale.n_c: parameter n_c has a scale but is not searched"),
    settings("a log scale through zero", "ranges: {R_m: [0, 3]}\nscale: {R_m: log}\n",
             "id.yaml:2:9: scale.R_m: parameter R_m: a log scale needs a positive range"),
    Case("a setting that is none", ["identify", "log.csv", "--set", "R_m"],
         ["--set R_m: write KEY=VALUE, for example ranges.K_m=[0.1,0.2]"]),
    Case("a setting of no YAML", ["identify", "log.csv", "--set", "ranges.R_m=[1"],
         ["--set ranges.R_m=[1: '[1' is not valid YAML"]),
    Case("a mistyped setting", ["identify", "log.csv", "--set", "rangs.R_m=[1,2]"],
         ["--set rangs: unknown key; did you mean 'ranges'?"]),
    Case("a setting over a file's", ["identify", "log.csv", "--config", "id.yaml", "--set",
                                     "ranges.K_m=[2,1]"],
         ["--set ranges.K_m: low end 2 is not below high end 1"]),
    Case("a file's mistake beside a setting", ["identify", "log.csv", "--config", "id.yaml",
                                               "--set", "ranges.R_m=[1,2]"],
         ["id.yaml:2:3: ranges.K_n: model actuator has no such name"],
         {"id.yaml": "ranges:\n  K_n: [1, 2]\n"}),
    settings("an unknown output", "weights: {omga: 2}\n",
             "id.yaml:1:11: weights.omga: model actuator has no such name; did you mean 'omega'?"),
    settings("an unknown preset in a file", "preset: thesys\n",
             "id.yaml:1:1: preset: it must be 'default', 'thesis', 'cega' or 'classic'",
             "found 'thesys'; did you mean 'thesis'?"),
    settings("an unknown model in a file", "population: 9\nmodel: actuater\n",
             "id.yaml:2:1: model: unknown model 'actuater'; did you mean 'actuator'?"),
    settings("population of one", "population: 1\n",
             "id.yaml:1:1: population: it must be at least 2, found 1"),
    settings("an empty configuration", "", "id.yaml: the file is empty"),
    settings("a column without a source",
             COLUMNS.replace("u: {column: cmd_voltage_motor}", "u: {}"),
             "id.yaml:5:5: columns.inputs.u: give either 'column'", "or 'constant'"),
    settings("no time at all", COLUMNS.replace("{column: t}", "{unit: ms}"),
             "id.yaml:3:3: columns.time: give either 'column'", "or 'sample_rate' (rows per"),
    settings("a sample rate of zero", COLUMNS.replace("{column: t}", "{sample_rate: 0}"),
             "id.yaml:3:10: columns.time.sample_rate: it must be above 0, found 0"),
    settings("a misspelt key of a column", COLUMNS.replace("{column: theta}", "{colum: theta}"),
             "id.yaml:7:9: columns.outputs.y.colum: unknown key; did you mean 'column'?"),
    settings("an unknown signal", COLUMNS.replace("  u:", "  v:"),
             "id.yaml:5:5: columns.inputs.v: model lag has no such signal; known are u"),
    settings("a missing signal", COLUMNS.replace("  outputs:\n    y: {column: theta}\n",
                                                 "  outputs: {}\n"),
             "id.yaml:6:3: columns.outputs: 'y' of model lag is missing"),
    settings("an unknown unit", COLUMNS.replace("column: theta", "column: theta, unit: parrot"),
             "columns.outputs.y.unit: unit 'parrot' is not understood; write it as in"),
    settings("turns or radians", COLUMNS.replace("column: theta", "column: theta, unit: rad*m"),
             "id.yaml:7:24: columns.outputs.y.unit: 'rad*m' does not say whether it counts turns"),
    settings("a unit of another kind", COLUMNS.replace("column: theta", "column: theta, unit: kg"),
             "id.yaml:7:24: columns.outputs.y.unit: 'kg' does not convert to 'm'"),
    settings("a column that is not there", COLUMNS.replace("theta", "thet"),
             "id.yaml:7:9: columns.outputs.y.column: log.csv has no column 'thet'; did you mean"),
    settings("a column of two signals", COLUMNS.replace("theta", "cmd_voltage_motor"),
             "id.yaml:7:9: columns.outputs.y.column: 'cmd_voltage_motor' is the column of "
             "columns.inputs.u already; each signal has its own"),
    settings("a wrong signal, a wrong column and a wrong unit",
             COLUMNS.replace("  u:", "  v:").replace("column: theta", "column: thet, unit: kg"),
             "id.yaml:5:5: columns.inputs.v: model lag has no such signal",
             "id.yaml:7:9: columns.outputs.y.column: log.csv has no column 'thet'",
             "id.yaml:7:23: columns.outputs.y.unit: 'kg' does not convert to 'm'"),
    Case("milliseconds read as seconds", ["identify", "log.csv", "--config", "id.yaml"],
         ["id.yaml:3:10: columns.time.unit: read in s, times of log.csv cover 4001 sample times of "
          "0.001 s, of which it holds 3, too few", "write the unit that they are in: s, ms, us"],
         {"id.yaml": COLUMNS.replace("{column: t}", "{unit: s, column: t, grid: 1 ms}"),
          "log.csv": ROWS + "0,0,0\n2,0,0\n4,0,1\n"}),
    Case("a result for a configuration", ["identify", "log.csv", "--config", "id.yaml"],
         ["id.yaml:2:1: this is a result of an identification, and should be its settings; give "
          "--config the file of settings, and a result with --given to keep what it holds, or "
          "with --parameters where a command has that"],
         {"id.yaml": "model: actuator\nverdict: {trust: good}\nparameters: {}\nmetrics: {}\n"}),
    Case("a result for a rig", ["run", "prbs.yaml", "--rig", "rig.yaml"],
         ["rig.yaml:2:1: this is a result of an identification, and should be a rig;"],
         {"rig.yaml": "model: actuator\nverdict: {trust: good}\nmetrics: {}\n"}),
    Case("missing configuration", ["identify", "log.csv", "--config", "absent.yaml"],
         ["absent.yaml: there is no such file; check its name"]),
    Case("files to begin with where nothing can be made", ["init", "/proc/none"],
         ["/proc/none", "cannot be created", "name another folder"]),
    Case("a protocol's key misspelt", ["run", "p.yaml"],
         ["p.yaml:1:1: protocol: this key is missing", "is 'protocoll' meant to be it?"],
         {"p.yaml": "protocoll: prbs\n"}),
    Case("an option that a setting gives as well",
         ["identify", "log.csv", "--seed", "1", "--set", "seed=2"],
         ["--set seed: --seed gives it as well; keep one of them"]),
    Case("an unknown preset", ["identify", "log.csv", "--preset", "thesys"],
         ["--preset: it must be 'default', 'thesis', 'cega' or 'classic', found 'thesys'; did you",
          "mean 'thesis'?"]),
    Case("a population of one", ["identify", "log.csv", "--population", "1"],
         ["--population: it must be at least 2, found 1"]),
    Case("an unknown model", ["identify", "log.csv", "--model", "actuater"],
         ["unknown model 'actuater'; did you mean 'actuator'?"]),
    Case("an unknown model for a run", ["run", "e.yaml", "--identify", "--model", "actuater"],
         ["unknown model 'actuater'"]),
    Case("an unknown model of an experiment", ["run", "m.yaml", "--identify"],
         ["m.yaml:1:1: model: unknown model 'actuater'; did you mean 'actuator'?"],
         {"m.yaml": "model: actuater\n" + EXPERIMENT}),
    Case("missing model file", ["run", "e.yaml", "--identify", "--model", "absent.py:model"],
         ["absent.py: there is no such model file"]),
    Case("results below a file", ["identify", "log.csv", "--out", "rig.yaml/results"],
         ["rig.yaml/results: cannot be created", "--out"]),
    Case("one log for training and validation",
         ["identify", "log.csv", "--validate", "./log.csv", "--model", "model.py:model",
          "--config", "id.yaml"],
         ["log.csv: the same log is given for training and for validation"], {"id.yaml": COLUMNS}),
    # --- logs
    Case("missing log", ["identify", "absent.csv"],
         ["absent.csv: there is no such log; name a capture folder or a CSV file"]),
    Case("a folder without logs", ["identify", "folder"],
         ["folder: neither a capture folder (with log.csv) nor a folder of CSV files or captures"]),
    log("an empty log", "", "log.csv: the log is empty; it must start with a line of column names"),
    log("a log with one row", original_text(1), "log.csv: it holds 1 sample; at least 2"),
    log("a log with a column missing", original_text().replace("torque", "torq"),
        "log.csv:1: column 'torque' is missing; did you mean 'torq'?", "--config"),
    log("a log with NaN", original_text().replace("0.75", "nan"),
        "log.csv:5: current_motor: 'nan' is not a finite number", "remove these lines"),
    foreign_log("an infinite output", ["0,1,0", "0.1,1,1e999", "0.2,1,3"],
                "log.csv:3: theta: '1e999' is not a finite number"),
    foreign_log("an infinite input", ["0,1,0", "0.1,inf,1", "0.2,1,3"],
                "log.csv:3: cmd_voltage_motor: 'inf' is not a finite number"),
    foreign_log("a complex output", ["0,1,0", "0.1,1,1+2j", "0.2,1,3"],
                "log.csv:3: theta: '1+2j' is not a finite number"),
    foreign_log("a time that stands still", ["0,1,0", "0.1,1,1", "0.1,1,3"],
                "log.csv:4: t: time does not advance from the line before"),
    foreign_log("an output of zero", [f"{0.1 * k:.1f},{k % 2},0" for k in range(20)],
                "log.csv: log: y is 0 throughout, so that there is no deviation to explain"),
    foreign_log("an output that never changes", [f"{0.1 * k:.1f},{k % 2},3" for k in range(20)],
                "log.csv: log: y is 3 throughout, so that there is no deviation to explain"),
    foreign_log("a log of two rows", ["0,1,0", "0.1,1,1"],
                "log: too short: after its first sample it has 1 measured value, for 1 unknown;",
                "give a longer record"),
    log("a binary log", b"\x89PNG\r\n\x1a\n\x00", "log.csv:1: not a text file"),
    Case("a broken run record", ["identify", "run"],
         ["run.json:1:2: not a readable run record", "move it away"],
         {"run/log.csv": original_text(), "run/run.json": "{"}),
    Case("replay of parameters that are none", ["replay", "log.csv", "--parameters", "p.yaml"],
         ["p.yaml:1:1: model: this key is missing"], {"p.yaml": "a: 1\n"}),
    Case("replay of a log for parameters", ["replay", "log.csv", "--parameters", "log.csv"],
         ["rig: log.csv: this is a log; name its identification's folder, or a parameters.yaml"]),
    Case("replay of an unknown parameter", ["replay", "log.csv", "--parameters", "p.yaml"],
         ["p.yaml:3:3: parameters.K_n: model actuator has no such parameter"],
         {"p.yaml": "model: actuator\nparameters:\n  K_n: 1\n"}),
    Case("replay of a text for a parameter", ["replay", "log.csv", "--parameters", "p.yaml"],
         ["p.yaml:3:3: parameters.K_m: expected a number, found 'x'"],
         {"p.yaml": "model: actuator\nparameters:\n  K_m: x\n"}),
    Case("replay of a number that is none", ["replay", "log.csv", "--parameters", "p.yaml"],
         ["p.yaml:3:3: parameters.K_m: expected a finite number, found nan"],
         {"p.yaml": "model: actuator\nparameters:\n  K_m: .nan\n"}),
    # --- models
    model("a model with a syntax error", MODEL.replace("(x, u, p):", "(x, u, p)"),
          "model.py:4: the model file does not import: SyntaxError"),
    model("a model that imports what is not there", "import no_such_thing\n" + MODEL,
          "model.py:1: the model file does not import: ModuleNotFoundError", "no_such_thing"),
    model("a model that fails", MODEL + "\n1 / 0\n",
          "model.py:18: the model file does not import: ZeroDivisionError"),
    model("a model that ends the program", MODEL + "\nraise SystemExit(0)\n",
          "model.py:18: the model file does not import: SystemExit"),
    model("a model without that object", MODEL, "model.py: it defines no 'modle'",
          "did you mean 'model'?", of="model.py:modle"),
    model("an object that is no model", "model = 3\n", "model.py:model is of type int",
          "not a sysid.ProcessModel"),
]  # fmt: skip


def lay_out(folder, case):
    good = {
        "e.yaml": EXPERIMENT, "rig.yaml": RIG, "id.yaml": IDENTIFICATION,
        "log.csv": original_text(), "model.py": MODEL,
    }  # fmt: skip
    (folder / "folder").mkdir(parents=True)
    for name, text in {**good, **case.files}.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory, request):
    """All selected cases: how the command ended, files before, files after."""
    chosen = {item.callspec.params["case"].name for item in request.session.items
              if item.fspath == request.fspath and hasattr(item, "callspec")}  # fmt: skip
    root = tmp_path_factory.mktemp("bad")

    found = {}
    with forked_rig() as run:
        for index, case in enumerate(case for case in CASES if case.name in chosen):
            folder = root / str(index)
            lay_out(folder, case)
            before = contents(folder)
            found[case.name] = run(case.args, folder), before, contents(folder)
    return found


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_mistake_is_refused_with_its_place_and_cure(case, outcomes):
    result, before, after = outcomes[case.name]
    print(result.stderr)
    assert result.returncode == 2
    for part in case.said:
        assert part in result.stderr.replace(os.sep, "/")
    for word in ("Traceback", "pydantic", "Input should", "valid dictionary", "Errno"):
        assert word not in result.stderr
    assert result.stdout == ""
    assert after == before, "nothing may be left behind"


def test_the_good_files_are_good(tmp_path):
    case = Case("good", [], [])
    lay_out(tmp_path, case)
    for args in (
        ["check", "e.yaml", "--rig", "rig.yaml"],
        ["models", "model.py:model"],
        ["identify", "log.csv", "--config", "id.yaml", "--help"],
    ):
        result = rig(*args, cwd=tmp_path)
        assert result.returncode == 0, result.stderr


def test_several_mistakes_in_one_file_are_told_at_once_in_its_order(tmp_path):
    text = (
        EXPERIMENT.replace("duration: 0.5", "duration: x")
        .replace("seed: 5", "seed: -5")
        .replace("  offset: 0.1", "  amplitude: 0.1")
        .replace("calibration", "calibrtion")
    )
    lay_out(tmp_path, Case("", [], [], {"e.yaml": text}))
    result = rig("check", "e.yaml", cwd=tmp_path)
    told = [line.split(": ")[1:3] for line in result.stderr.splitlines()]
    assert told == [
        ["e.yaml:3:1", "duration"],
        ["e.yaml:4:1", "calibrtion"],
        ["e.yaml:7:3", "motor.amplitude"],
        ["e.yaml:14:3", "brake.seed"],
    ]


def test_mistakes_are_told_together_wherever_they_stand_in_a_file(tmp_path):
    wrong = EXPERIMENT.replace("protocol: prbs", "protocol: prbx").replace(
        "duration", "sample_rate"
    )
    checked = EXPERIMENT.replace("seed: 4", "seed: 0") + "validation: {brake: {sead: 5}}\n"
    bench = RIG.replace("simulated", "serail").replace("0.706", "-1")
    options = RIG.replace("seed: 3", "plan: 3").replace("0.706", "-1") + "plant: {}\n"
    files = {"a.yaml": wrong, "b.yaml": checked, "c.yaml": bench, "d.yaml": options}
    lay_out(tmp_path, Case("", [], [], files))
    expected = {
        ("a.yaml",): ["1:1: protocol", "3:1: sample_rate"],
        ("b.yaml",): ["9:3: motor.seed", "15:22: validation.brake.sead"],
        ("e.yaml", "--rig", "c.yaml"): ["2:1: backend", "6:12: sensors.torque.scale"],
        ("e.yaml", "--rig", "d.yaml"): [
            "4:3: options.plan", "6:12: sensors.torque.scale", "10:1: plant",
        ],
    }  # fmt: skip
    for args, places in expected.items():
        result = rig("check", *args, cwd=tmp_path)
        lines = result.stderr.splitlines()
        assert len(lines) == len(places), result.stderr
        for line, place in zip(lines, places, strict=True):
            assert line.startswith(f"rig: {args[-1]}:{place}: ")
    assert "it belongs under options" in result.stderr
    both = rig("check", "b.yaml", "--rig", "c.yaml", cwd=tmp_path)
    assert len(both.stderr.splitlines()) == 4, both.stderr


def test_quantities_with_units_are_what_they_stand_for(tmp_path):
    text = EXPERIMENT.replace("0.75", "750 mV").replace("0.005", "5 ms").replace("800", "0.8 kHz")
    lay_out(tmp_path, Case("", [], [], {"e.yaml": text, "plain.yaml": EXPERIMENT}))
    told = [
        {**json.loads(rig("check", name, "--json", cwd=tmp_path).stdout), "experiment": ""}
        for name in ("e.yaml", "plain.yaml")
    ]
    assert told[0] == told[1]
