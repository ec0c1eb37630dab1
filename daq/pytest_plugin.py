"""A pytest plugin for labs: a seeded simulated rig and replayed logs as fixtures.

Installed with the package. Options: ``--rig-seed N`` seeds ``simulated_rig``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from daq.progress import Event, Note

if TYPE_CHECKING:
    import pandas as pd

    from daq.findings import Findings
    from daq.identification.replay import Replay
    from daq.logs.recording import Recording

_RIG = "simulated.yaml"


@dataclass(frozen=True)
class Recorded:
    """A run on the simulated rig: its recording and what its protocol concluded."""

    recording: Recording
    findings: Findings | None

    @property
    def folder(self) -> Path:
        """Its capture folder."""
        return self.recording.folder

    @property
    def frame(self) -> pd.DataFrame:
        """The log in SI units, one row per sample."""
        return self.recording.frame


@dataclass(frozen=True)
class SimulatedRig:
    """Runs experiments on a simulated rig; one seed gives the same logs to the bit.

    tests: where files are looked up first. root: where capture folders go.
    """

    seed: int
    tests: Path
    root: Path

    def run(
        self, experiment: str | Path, rig: str | Path | None = None, **options: Any
    ) -> Recorded:
        """Run an experiment's YAML to its end.

        options: of the simulated rig, over those of its file, such as ``ideal=True`` or
        ``plant={"load": "free"}``. Raises what ``rig run`` reports: ConfigError, InterlockError,
        DeviceError, RunError.
        """
        from daq import record
        from daq.recording.analysis import conclude_or_warn, recorded_experiment

        recording = record(
            _beside(self.tests, experiment),
            None if rig is None else _beside(self.tests, rig),
            self.root,
            options={"seed": self.seed, **options},
        )
        protocol = recorded_experiment(recording.folder, trust=True)  # the test has named it
        return Recorded(recording, conclude_or_warn(protocol, recording.folder, _warn))


@dataclass(frozen=True)
class Replayer:
    """``replay(log)`` simulates a log's inputs and compares with what was measured.

    tests: where files are looked up first.
    """

    tests: Path

    def __call__(
        self,
        log: str | Path,
        parameters: str | Path | None = None,
        *,
        rig: str | Path = _RIG,
        config: str | Path | None = None,
        trust: bool = False,
    ) -> Replay:
        """The outputs of a model under the log's applied commands and measured load.

        log: capture folder or CSV. parameters: ``parameters.yaml`` of an identification, or its
        folder; default the simulated rig's own. config: names the columns of a foreign log. trust:
        run the Python file of a model that ``parameters.yaml`` names. The result has ``fit`` [%],
        ``rmse`` and ``msd`` by output, and the arrays. Raises ConfigError.
        """
        from daq import replay

        return replay(
            _beside(self.tests, log),
            None if parameters is None else _beside(self.tests, parameters),
            _beside(self.tests, rig),
            None if config is None else _beside(self.tests, config),
            trust=trust,
        )


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--rig-seed``."""
    parser.getgroup("hybrid-rig").addoption(
        "--rig-seed", type=int, default=0, metavar="N", help="seed of the fixture simulated_rig"
    )


@pytest.fixture
def simulated_rig(request: pytest.FixtureRequest, tmp_path: Path) -> SimulatedRig:
    """A simulated rig; logs go to the test's temporary folder, the seed into a failure's report."""
    seed = request.config.getoption("--rig-seed")
    request.node.add_report_section("setup", "rig", f"simulated rig with --rig-seed {seed}")
    return SimulatedRig(seed, request.path.parent, tmp_path / "runs")


@pytest.fixture
def replay(request: pytest.FixtureRequest) -> Replayer:
    """Replays logs through a model: ``assert replay("log.csv").fit["omega"] > 80``."""
    return Replayer(request.path.parent)


def _beside(folder: Path, name: str | Path) -> str:
    """A file beside the test; otherwise the name as it is, as the command line takes it."""
    beside = folder / name
    return str(beside) if beside.exists() else str(name)


def _warn(event: Event) -> None:
    """Say why nothing follows from a run, as ``rig run`` does."""
    if isinstance(event, Note):
        sys.stderr.write(f"rig: {event.level}: {event.text}\n")
