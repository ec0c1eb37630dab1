"""What an identification hardly knows, and the command that designs runs for it.

How narrow the intervals would become takes many simulations: that command says it, beside the
intervals as they are.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq import notation
from daq.errors import ConfigError
from daq.logs.capture import read_record, settings_of
from daq.lookup.shipped import find_file

if TYPE_CHECKING:
    from sysid.uncertainty import Estimate, Uncertainty

_SIMULATED = "simulated"  # the backend that tells its plant
_WIDE = 0.1  # half width in parts of the value, from which a quantity counts as hardly known
_NAMED = 4  # of the quantities, the widest


def hardly_known(uncertainty: Uncertainty) -> list[Estimate]:
    """What experiments can tell and these data hardly do, the widest first.

    Not what has several answers, whose intervals hold for one of them, nor where a log started.
    """
    vague = [estimate for estimate in uncertainty.parameters if estimate.why == "vague"]
    quantities = [e for e in (*uncertainty.determined(), *vague) if "(0)" not in e.name]
    wide = [estimate for estimate in quantities if _half_width(estimate) > _WIDE]
    return sorted(wide, key=_half_width, reverse=True)


def knowledge(estimates: Sequence[Estimate]) -> str:
    """How well one or more quantities are known, in words.

    >>> from sysid.uncertainty import Estimate
    >>> ends = [("c1", 1.0, None), ("c0", None, 2.0), ("R_m", 0.8, 1.2)]
    >>> knowledge([Estimate(name, "1", 1.0, low=low, high=high) for name, low, high in ends])
    'Little is known of c1, c0 (one end only), R_m (to 20 %)'
    """
    alike: dict[str, list[str]] = {}
    for estimate in estimates[:_NAMED]:
        alike.setdefault(_known(estimate), []).append(estimate.name)
    parts = [f"{', '.join(names)} ({how})" for how, names in alike.items()]
    if len(estimates) > _NAMED:
        parts.append(f"{len(estimates) - _NAMED} more (to no better than {100.0 * _WIDE:g} %)")
    return f"Little is known of {', '.join(parts)}"


def design_command(parameters: Path, logs: Sequence[Path], more: Sequence[str] = ()) -> str | None:
    """``rig design`` from a result, for the rig that its logs are of; None where none is known.

    more: further words, such as those of the model.
    """
    records = {log.parent: record for log in logs if (record := read_record(log)) is not None}
    rigs = {str(record.get("rig_file", "")) for record in records.values()}
    if len(rigs) != 1 or not (rig := rigs.pop()):
        return None
    try:
        find_file("backend", rig)  # and no more: a record that was sent must run nobody's code
    except ConfigError:  # it is not there any more, or was typed elsewhere
        return None
    simulated = all(
        settings_of(record)[1].get("backend") == _SIMULATED for record in records.values()
    )
    words = ["rig", "design", "--rig", rig, "--parameters", str(parameters)]
    calibrated = [folder for folder, record in records.items() if _noise(record)]
    words += ["--log", str(calibrated[0])] if calibrated else []
    words += [*more, "--precision", f"{100.0 * _WIDE:g}%"]
    return shlex.join(words) + ("" if simulated else " --plant PLANT")


def _noise(record: Mapping[str, Any]) -> Any:
    """Of the sensors, as a run's calibration found it."""
    return record.get("calibration", {}).get("noise")


def _known(estimate: Estimate) -> str:
    if estimate.why:
        return "hardly felt"
    if estimate.low is None or estimate.high is None:
        return "one end only"
    return f"to {notation.number(100.0 * _half_width(estimate), 2)} %"


def _half_width(estimate: Estimate) -> float:
    """Half the interval in parts of the value, infinite where an end is missing."""
    if estimate.low is None or estimate.high is None or not estimate.value:
        return float("inf")
    return 0.5 * (estimate.high - estimate.low) / abs(estimate.value)
