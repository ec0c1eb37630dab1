"""Texts on how punctual a run was."""

from daq.run.runner import RunResult

_SHOWN = 5  # ticks named in a note
_IN_LOTS = 3.0  # samples that come at once, on average


def summary_line(run: RunResult) -> str | None:
    """A line on the timing of a run that a clock paced; None for one that waited for the host."""
    if not run.realtime["needed"]:
        return None
    arrival, answer = run.timing["arrival"], run.timing["answer"]
    blocks = f"in blocks of {_lot(run):.0f}, " if _lot(run) > _IN_LOTS else ""
    line = (
        f"Timing: samples came {blocks}every {_short(arrival['mean_seconds'])}, "
        f"at worst after {_short(arrival['worst_seconds'])}"
    )
    if answer is not None:
        line += (
            f"; answered in {_short(answer['median_seconds'])}, "
            f"at worst in {_short(answer['worst_seconds'])} (sample {answer['worst_tick']})"
        )
    granted = run.realtime["granted"].get("scheduler")
    return f"{line}; scheduling: {granted or 'ordinary'}"


def notes(run: RunResult) -> list[str]:
    """Notes on late commands and lost samples, each with its cure."""
    texts = []
    late, lost = run.timing["late"], run.timing["lost"]
    if late["commands"]:
        texts.append(
            f"{_many(late['commands'], 'command')} of {run.n_samples} came too late; the device "
            f"held the one before ({_places('sample', late['first_ticks'], late['commands'])})."
            f"{_haste(run)}"
        )
    if lost["samples"]:
        gaps = len(lost["after_ticks"])
        texts.append(
            f"{_many(lost['samples'], 'sample')} did not arrive "
            f"({_places('after sample', lost['after_ticks'], gaps)}); the log keeps the gap in "
            "time. Check the connection, or sample more slowly"
        )
    return texts


def _lot(run: RunResult) -> float:
    """Samples that came at once, on average."""
    return float(run.n_samples / max(run.timing["blocks"], 1))


def _haste(run: RunResult) -> str:
    if not run.realtime["needed"]:
        return ""
    if _lot(run) > _IN_LOTS:
        apart = run.timing["arrival"]["mean_seconds"]
        return (
            f" Samples come in blocks, {_short(apart)} apart: the line or its adapter holds them "
            "back. 'rig doctor' looks at an adapter's latency timer"
        )
    cure = " Raise 'ahead' or lower 'sample_rate' in the experiment"
    if run.realtime["refused"] or run.realtime["asked"] == "off":
        cure += ", or allow real-time scheduling (docs/safety.md)"
    return cure


def _places(what: str, ticks: list[int], count: int) -> str:
    shown = ", ".join(str(tick) for tick in ticks[:_SHOWN])
    more = ", ..." if count > min(len(ticks), _SHOWN) else ""
    return f"{what}{'s' if len(ticks) > 1 else ''} {shown}{more}"


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count != 1 else ''}"


def _short(seconds: float) -> str:
    return f"{seconds * 1e3:.3g} ms" if seconds >= 1e-4 else f"{seconds * 1e6:.3g} us"
