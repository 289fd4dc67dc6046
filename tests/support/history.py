"""Stand-ins for calibrations where only the history is looked at, and a process that writes without end."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

from tests.support.source import ROOT

if TYPE_CHECKING:
    from calibrate import Calibration

CELL = "volume"


@dataclass(frozen=True)
class Named:
    """What the history reads of a calibration."""

    id: str
    verdict: str = "pass"
    cell_name: str = CELL
    created_utc: str = "2026-01-01T00:00:00Z"
    inputs: dict[str, object] = field(default_factory=dict)


def named(number: int, verdict: str = "pass", **inputs: object) -> Calibration:
    """A calibration by number: its id begins with six digits of it."""
    return cast("Calibration", Named(f"{number:06x}" + f"{number:058x}", verdict, inputs=dict(inputs)))


def file_of(folder: Path, number: int) -> Path:
    """A file to be kept of it."""
    path = folder / f"calibration{number}.yaml"
    path.write_text(f"format: spherecal-calibration/1\nnumber: {number}\n", encoding="utf-8")
    return path


_WRITER = """
import sys
from types import SimpleNamespace
from measure.history.store import History
place, who, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
calibration = SimpleNamespace(id=who * 64, cell_name="volume")
with History.open(place) as history:
    number = 0
    while count == 0 or number < count:
        history.add_result("check", calibration, {"verdict": "conform", "number": number}, verdict="conform", taken_utc=None, software="tests")
        number += 1
        print(number, flush=True)
"""


def writer(place: str, who: str, count: int = 0) -> subprocess.Popen[str]:
    """Another process that writes checks, each told on a line when it is kept; without end if the count is 0."""
    return subprocess.Popen(
        [sys.executable, "-c", _WRITER, place, who, str(count)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
