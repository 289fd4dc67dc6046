"""Real recordings by way of `import`: the list that their robot wrote gives the calibration of their session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calibrate import Calibration
from drivers.files.session import Session, read_session
from tests.system.conftest import Cli


def as_their_robot_wrote_it(session: Session) -> str:
    """x y z in mm and angles about the fixed axes x, y, z in degrees, three decimals each, no header."""
    lines = []
    for shot in session.shots:
        assert shot.base_from_flange is not None
        angles = Rotation.from_matrix(shot.base_from_flange[:3, :3]).as_euler("xyz", degrees=True)
        lines.append(" ".join(f"{number:.3f}" for number in [*shot.base_from_flange[:3, 3], *angles]))
    return "\n".join(lines)


def test_real_arcs_imported_from_their_files_give_the_same_calibration(real_data: Path, tmp_path: Path, cli: Cli) -> None:
    original = real_data / "line_scanner" / "r40_a"
    session = read_session(original)
    poses = tmp_path / "poses.txt"
    poses.write_text(as_their_robot_wrote_it(session), encoding="utf-8")
    arguments = ("import", original / "cell.yaml", poses, "--clouds", original / "scans", "-o", tmp_path / "session", "--json")
    refused = cli(*arguments)
    assert refused.code == 1
    assert "possible: " in refused.told["error"]["message"]
    assert cli(*arguments, "--rotation", "fixed-xyz").code == 0
    imported = read_session(tmp_path / "session")
    # the robot's three decimals are all there is
    for ours, theirs in zip(imported.shots, session.shots, strict=True):
        assert ours.base_from_flange is not None
        assert theirs.base_from_flange is not None
        np.testing.assert_allclose(ours.base_from_flange, theirs.base_from_flange, atol=5e-9)
    found = []
    for folder in (original, tmp_path / "session"):
        assert cli("calibrate", folder, "-o", tmp_path / f"{folder.name}.yaml", "--json").code == 0
        found.append(Calibration.load(tmp_path / f"{folder.name}.yaml"))
    first, second = found
    np.testing.assert_allclose(second.flange_from_camera, first.flange_from_camera, atol=1e-5)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(second.statistics.cross_validated_rms_mm, first.statistics.cross_validated_rms_mm, atol=1e-6)
    assert second.verdict == first.verdict
