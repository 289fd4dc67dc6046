"""One small simulated cell, planned and captured once through the command line, for all system tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from measure.cli import app
from measure.cli_run import run_app
from measure.demo_cell import write_demo_cell

RESOLUTION_PX = (240, 150)
N_CALIBRATION, N_VERIFICATION, N_WORKPIECE = 36, 12, 4


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one command did."""

    code: int
    out: str
    err: str

    @property
    def told(self) -> dict[str, Any]:
        """The one JSON object on stdout."""
        if self.out.count("\n") != 1:
            pytest.fail(f"stdout is not one line: {self.out!r}")
        found: dict[str, Any] = json.loads(self.out)
        return found


Cli = Callable[..., Outcome]


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run one command in this process, its streams caught."""

    def run(*arguments: object) -> Outcome:
        capfd.readouterr()
        code = run_app(app, [str(argument) for argument in arguments])
        return Outcome(code, *capfd.readouterr())

    return run


@dataclass(frozen=True, slots=True)
class SmallCell:
    """Files of the small cell; tests only read them."""

    folder: Path

    @property
    def cell(self) -> Path:
        """The cell file; the hidden truth lies beside it."""
        return self.folder / "cell.yaml"

    @property
    def calibration_session(self) -> Path:
        """Six spheres, three certified lengths."""
        return self.folder / "calibration"

    @property
    def verification_session(self) -> Path:
        """Four other spheres, six lengths that no calibration uses."""
        return self.folder / "verification"

    @property
    def workpiece_session(self) -> Path:
        """Scans of the workpiece."""
        return self.folder / "workpiece"


def _run(*arguments: object) -> None:
    if (code := run_app(app, [str(argument) for argument in arguments])) != 0:
        pytest.fail(f"spherecal {' '.join(str(a) for a in arguments)} gave {code}")


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> SmallCell:
    """The small cell with its three sessions."""
    small = SmallCell(tmp_path_factory.mktemp("small"))
    write_demo_cell(small.folder, 7, RESOLUTION_PX)
    plans = {
        small.calibration_session: ["--for", "calibrate", "-n", N_CALIBRATION, *_spheres("ABCDEF")],
        small.verification_session: ["--for", "verify", "-n", N_VERIFICATION, *_spheres("GHIJ")],
        small.workpiece_session: ["--for", "workpiece", "-n", N_WORKPIECE, "--region", 930, -40, 60, 1110, 100, 140],
    }
    for session, options in plans.items():
        plan = small.folder / f"{session.name}_plan.yaml"
        _run("plan", small.cell, *options, "-o", plan, "-q")
        _run("capture", small.cell, plan, "-o", session, "--yes", "-q")
    return small


def _spheres(names: str) -> list[str]:
    return [part for name in names for part in ("--sphere", name)]


@pytest.fixture(scope="session")
def calibration(small: SmallCell) -> Path:
    """The calibration of the small cell."""
    path = small.folder / "calibration.yaml"
    _run("calibrate", small.calibration_session, "-o", path, "-q")
    return path
