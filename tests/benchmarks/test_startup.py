"""How long an operator waits for the command line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.timing import best_of, tell

pytestmark = pytest.mark.bench

COMMAND = Path(sys.executable).with_name("spherecal")


def test_help_feels_instant() -> None:
    def run() -> None:
        subprocess.run([COMMAND, "--help"], check=True, capture_output=True)

    best_s = best_of(5, run)
    tell("spherecal --help, best of 5", best_s, "limit 700 ms")
    assert best_s < 0.7
