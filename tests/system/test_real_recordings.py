"""The real line-scanner recordings through the command line (issue 2): no first guess, flange poses only, every arc used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.system.conftest import Cli


@pytest.mark.parametrize(("name", "held_out_mm"), [("r40_a", 0.16), ("r40_b", 0.20)])
def test_every_arc_is_predicted_by_a_solve_that_never_saw_it(name: str, held_out_mm: float, real_data: Path, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "calibration.yaml"
    result = cli("calibrate", real_data / "line_scanner" / name, "-o", out, "--json")
    assert result.code == 0, result.err
    told = json.loads(result.out)
    assert (told["n_shots"], told["used"], told["rejected"]) == (15, 15, [])
    assert told["cross_validated_rms_mm"] <= held_out_mm
    assert told["verdict"] == "marginal"
    assert any("uncalibrated" in reason and "robot" in reason for reason in told["reasons"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibration.yaml"]
