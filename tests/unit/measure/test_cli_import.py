"""`spherecal import`: the session of another program's files is the session that they were made from."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.export import export_text
from calibrate.export_target_files import parse_targets
from drivers.files.ply import encode_ply, write_ply
from drivers.files.session import Session, read_scan, read_session
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics.se3 import FloatArray
from measure.cli import app
from measure.cli_run import run_app
from tests.support.exporting import seen_poses, shipped_calibration
from tests.support.recorded import record_session, write_cell

Import = Callable[..., tuple[int, Any, str]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("recorded")
    return record_session(folder / "session", write_cell(folder), np.random.default_rng(4), shots_per_sphere=3, n_points=60)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Import:
    def call(*arguments: object) -> tuple[int, Any, str]:
        code = run_app(app, ["import", *map(str, arguments), "--json"])
        out, err = capfd.readouterr()
        assert out.count("\n") == 1
        return code, json.loads(out), err

    return call


def joints_of(session: Session) -> FloatArray:
    return np.array([shot.joints_rad for shot in session.shots], dtype=np.float64)


def poses_of(session: Session) -> FloatArray:
    return np.array([shot.base_from_flange for shot in session.shots], dtype=np.float64)


def points_of(session: Session) -> list[FloatArray]:
    return [read_scan(session, shot).points_mm.astype(np.float64) for shot in session.shots]


def write_list(folder: Path, session: Session, *, header: bool = True) -> Path:
    """German spreadsheet: semicolons, decimal commas, degrees, millimetres, angles about fixed axes."""
    folder.mkdir(exist_ok=True)
    lines = ["Nr;Kugel;sphere;J1 [deg];J2 [deg];J3 [deg];J4 [deg];J5 [deg];J6 [deg];X [mm];Y [mm];Z [mm];Rx;Ry;Rz"] if header else []
    for i, (shot, pose) in enumerate(zip(session.shots, poses_of(session), strict=True)):
        angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        numbers = [*np.degrees(joints_of(session)[i]), *pose[:3, 3], *angles]
        lines.append(";".join([str(i + 1), "x", str(shot.sphere), *(f"{number:.7f}".replace(".", ",") for number in numbers)]))
    path = folder / "Posen.csv"
    path.write_text("\r\n".join(lines), encoding="utf-8-sig")
    return path


def write_clouds(folder: Path, session: Session, kind: str) -> Path:
    """The scans as another program exports them: metres, zeros for holes, numbers without leading zeros."""
    clouds = folder / "clouds"
    clouds.mkdir(parents=True)
    for i, points in enumerate(points_of(session)):
        metres = (np.vstack([points, np.full((2, 3), np.nan)]) / 1000).astype(np.float32)
        path = clouds / f"scan{i + 1}.{kind}"
        if kind == "ply":
            path.write_bytes(encode_ply(metres))
        elif kind == "npz":
            np.savez(path, points=np.nan_to_num(metres), unused=np.zeros(3))
        else:
            head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(metres)}\nHEIGHT 1\nPOINTS {len(metres)}\nDATA binary\n"
            path.write_bytes(head.encode() + np.nan_to_num(metres).tobytes())
    return clouds


def assert_same(found: Session, wanted: Session, tolerance: float = 1e-6) -> None:
    assert [shot.sphere for shot in found.shots] == [shot.sphere for shot in wanted.shots]
    np.testing.assert_allclose(joints_of(found), joints_of(wanted), atol=tolerance)
    np.testing.assert_allclose(poses_of(found), poses_of(wanted), atol=tolerance)
    for ours, theirs in zip(points_of(found), points_of(wanted), strict=True):
        np.testing.assert_allclose(ours[np.isfinite(ours).all(axis=1)], theirs, atol=1e-4)


@pytest.mark.parametrize("kind", ["ply", "pcd", "npz"])
def test_a_foreign_list_and_clouds_give_the_session_again(kind: str, recorded: Session, tmp_path: Path, run: Import) -> None:
    poses, clouds, out = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, kind), tmp_path / "session"
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "-o", out)
    assert (code, told["n_shots"], told["n_failed"], told["state"]) == (0, 6, 0, "complete")
    assert (told["rotation"], told["matched_by"]) == ("fixed-xyz", "number")
    assert told["units"] == {"joints": "deg", "positions": "mm", "angles": "deg", "clouds": "m"}
    found = read_session(out)
    assert_same(found, recorded)
    assert found.shots[1].extra["source"]["cloud"] == f"scan2.{kind}"  # type: ignore[index]
    assert found.shots[1].pose_id == "2"
    assert found.cell_path.read_bytes() == recorded.cell_path.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Posen.csv", "clouds", "session"]


def test_a_dry_run_tells_the_same_and_writes_nothing(recorded: Session, tmp_path: Path, run: Import, capfd: Any) -> None:
    poses, clouds = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, "ply")
    before = sorted(tmp_path.rglob("*"))
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "--dry-run")
    assert (code, told["n_shots"], told["n_poses"], told["state"], told["out"]) == (0, 0, 6, "dry_run", None)
    first = told["first_poses"][0]
    np.testing.assert_allclose(first["joints_rad"], joints_of(recorded)[0], atol=1e-8)
    np.testing.assert_allclose(first["base_from_flange"], poses_of(recorded)[0], atol=1e-6)
    assert first["spheres"] == [recorded.shots[0].sphere]
    assert run_app(app, ["import", str(recorded.cell_path), str(poses), "--clouds", str(clouds), "--dry-run"]) == 0
    said = capfd.readouterr().out
    for part in (
        "semicolons, with decimal commas",
        "columns that are not used: Kugel",
        "fixed-xyz in deg: of",
        "clouds in m",
        "scan1.ply",
        "nothing was written",
    ):
        assert part in said
    assert sorted(tmp_path.rglob("*")) == before


def test_nothing_is_left_of_an_import_that_fails(recorded: Session, tmp_path: Path, run: Import) -> None:
    poses, clouds, out = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, "ply"), tmp_path / "new" / "session"
    write_ply(clouds / "scan6.ply", np.full((3, 3), np.nan))
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "-o", out)
    assert (code, told["error"]["message"], told["error"]["file"]) == (1, "holds no point", str(clouds / "scan6.ply"))
    assert not list((tmp_path / "new").iterdir())
    (clouds / "scan6.ply").write_bytes(b"ply\n")
    assert run(recorded.cell_path, poses, "--clouds", clouds, "-o", out)[0] == 1
    assert not list((tmp_path / "new").iterdir())


def test_a_folder_in_use_is_not_touched(recorded: Session, tmp_path: Path, run: Import) -> None:
    poses, clouds = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, "ply")
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "-o", clouds)
    assert (code, told["error"]["message"]) == (1, "is there already and not an empty folder")
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds)
    assert (code, told["error"]["where"]) == (1, "--out")


def test_poses_without_a_cloud_become_failed_shots_where_allowed(recorded: Session, tmp_path: Path, run: Import) -> None:
    poses, clouds = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, "ply")
    (clouds / "scan2.ply").unlink()
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "-o", tmp_path / "session")
    assert code == 1
    assert "no cloud for 2 (line 3)" in told["error"]["message"]
    code, told, _ = run(recorded.cell_path, poses, "--clouds", clouds, "-o", tmp_path / "session", "--allow-missing")
    assert (code, told["n_shots"], told["n_failed"]) == (0, 5, 1)
    assert [shot.status for shot in read_session(tmp_path / "session").shots] == ["ok", "failed", "ok", "ok", "ok", "ok"]


def test_axes_of_the_clouds_and_several_spheres_in_view(recorded: Session, tmp_path: Path, run: Import) -> None:
    text = write_list(tmp_path, recorded).read_text(encoding="utf-8-sig").replace("sphere", "remark")
    (tmp_path / "Posen.csv").write_text(text, encoding="utf-8")
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    for i, points in enumerate(points_of(recorded)):
        write_ply(clouds / f"{i + 1}.ply", points * [1, -1, -1], comments=("unit mm",))
    arguments = (recorded.cell_path, tmp_path / "Posen.csv", "--clouds", clouds, "-o", tmp_path / "session", "--cloud-axes", "graphics")
    code, told, _ = run(*arguments)
    assert (code, told["error"]["where"]) == (1, "--sphere")
    code, told, _ = run(*arguments, "--sphere", "A", "--sphere", "B")
    assert (code, told["n_shots"], told["units"]["clouds"]) == (0, 12, "mm")
    found = read_session(tmp_path / "session")
    assert [(shot.sphere, shot.scan) for shot in found.shots[:3]] == [("A", "scans/0000.ply"), ("B", "scans/0000.ply"), ("A", "scans/0002.ply")]
    np.testing.assert_allclose(points_of(found)[0], points_of(recorded)[0], atol=1e-4)


def test_a_list_that_contradicts_the_robot_is_refused_with_the_likely_cause(recorded: Session, tmp_path: Path, run: Import) -> None:
    cell = parse_yaml(recorded.cell_path.read_text(encoding="utf-8"), file="cell")
    assert isinstance(cell, dict)
    other = tmp_path / "other.yaml"
    other.write_text(dump_yaml(cell | {"robot": {"driver": "recorded", "model": "ur5e"}}), encoding="utf-8")
    poses, clouds = write_list(tmp_path, recorded), write_clouds(tmp_path, recorded, "ply")
    code, told, _ = run(other, poses, "--clouds", clouds, "--dry-run", "--rotation", "fanuc")
    assert code == 1
    assert "disagree by" in told["error"]["message"]
    assert run(other, poses, "--clouds", clouds, "--dry-run", "--use", "joints")[0] == 0


@pytest.mark.parametrize("file_format", ["targets-csv", "targets-rapid"])
def test_exported_targets_are_read_as_the_axis_angles_that_they_are(file_format: str, tmp_path: Path, run: Import) -> None:
    """A controller is sent to corrected targets and a cloud is taken at each: the round trip of a calibrated cell."""
    calibration = shipped_calibration("abb_irb1410")
    near = seen_poses(calibration, 4)
    lines = ["joint1_rad,joint2_rad,joint3_rad,joint4_rad,joint5_rad,joint6_rad", *(",".join(map(repr, q.tolist())) for q in near)]
    targets = parse_targets("\n".join(lines), 6, file="targets.csv")
    path = tmp_path / ("targets.csv" if file_format == "targets-csv" else "targets.mod")
    text = export_text(calibration, file_format, targets=targets).text
    path.write_text(text, encoding="utf-8")
    numbers = [line for line in text.splitlines() if line.startswith(("target_", "CONST jointtarget"))]
    (tmp_path / "clouds").mkdir()
    for i in range(4):
        write_ply(tmp_path / "clouds" / f"{i}.ply", np.random.default_rng(i).normal([0, 0, 300], 5, (20, 3)))
    cell = {"format": "spherecal-cell/1", "name": "c", "robot": {"driver": "recorded", "model": "abb_irb1410"}, "camera": {"driver": "recorded"}}
    spheres = {"A": {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001}}
    (tmp_path / "cell.yaml").write_text(dump_yaml(cell | {"flange_from_camera": None, "spheres": spheres}), encoding="utf-8")
    code, told, _ = run(tmp_path / "cell.yaml", path, "--clouds", tmp_path / "clouds", "-o", tmp_path / "s", "--match", "order")
    assert (code, told["n_shots"], len(numbers)) == (0, 4, 4)
    found = joints_of(read_session(tmp_path / "s"))
    if file_format == "targets-csv":
        wanted = np.array([[float(cell) for cell in line.split(",")[1:7]] for line in numbers])
    else:
        wanted = np.radians([[float(cell) for cell in line.split("[[")[1].split("]")[0].split(",")] for line in numbers])
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.abs(found - near).max() < 0.05
