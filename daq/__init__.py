"""Rigs, runs and their logs; what the commands do, as functions for scripts and notebooks.

``check`` previews an experiment, ``record`` runs it, ``analyse`` concludes from a run, ``load``
reads a log, ``design``, ``identify``, ``resume``, ``compare``, ``campaign``, ``replay`` and
``tune`` do what the commands of these names do. They never print: ``watch`` is called with what
they say meanwhile. Each is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from daq.designs.design import design
    from daq.designs.result import DesignResult
    from daq.errors import ConfigError, RigError
    from daq.identification.campaign import CampaignRequest, CampaignResult, campaign
    from daq.identification.comparison import ComparisonRequest, ComparisonResult, compare
    from daq.identification.fit import identify, resume
    from daq.identification.replay import Replay, replay
    from daq.identification.result import Identification
    from daq.logs.recording import Recording, load
    from daq.recording.analysis import Analysis, analyse
    from daq.recording.preview import Preview, check
    from daq.recording.session import record
    from daq.tuning import Tuning, tune

_HOMES = {
    "Analysis": "daq.recording.analysis",
    "CampaignRequest": "daq.identification.campaign",
    "CampaignResult": "daq.identification.campaign",
    "ComparisonRequest": "daq.identification.comparison",
    "ComparisonResult": "daq.identification.comparison",
    "ConfigError": "daq.errors",
    "DesignResult": "daq.designs.result",
    "Identification": "daq.identification.result",
    "Preview": "daq.recording.preview",
    "Recording": "daq.logs.recording",
    "Replay": "daq.identification.replay",
    "RigError": "daq.errors",
    "Tuning": "daq.tuning",
    "analyse": "daq.recording.analysis",
    "campaign": "daq.identification.campaign",
    "check": "daq.recording.preview",
    "design": "daq.designs.design",
    "compare": "daq.identification.comparison",
    "identify": "daq.identification.fit",
    "load": "daq.logs.recording",
    "record": "daq.recording.session",
    "replay": "daq.identification.replay",
    "resume": "daq.identification.fit",
    "tune": "daq.tuning",
}

__all__ = [
    "Analysis",
    "CampaignRequest",
    "CampaignResult",
    "ComparisonRequest",
    "ComparisonResult",
    "ConfigError",
    "DesignResult",
    "Identification",
    "Preview",
    "Recording",
    "Replay",
    "RigError",
    "Tuning",
    "analyse",
    "campaign",
    "check",
    "compare",
    "design",
    "identify",
    "load",
    "record",
    "replay",
    "resume",
    "tune",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'daq' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
