"""A part from its scans to its verdict in one go: the same as stitching and inspecting, however the scans come."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate.result import Calibration
from drivers.errors import DataError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, read_scan, read_session
from drivers.kinematics import se3
from measure.cli import app
from measure.cli_run import run_app
from measure.console import json_text
from measure.history.store import History
from measure.inspecting.nominal import load_nominal
from measure.inspecting.region import region_of
from measure.inspecting.result import Inspection
from measure.inspecting.spec import Alignment, InspectionSpec, load_spec
from measure.part import CLOUD_FILE, Drawing, PartInProgress, measure_part
from measure.stitch import StitchSettings, scans_once
from tests.support.jobs import Parts, draw_ball, make_parts, read_lines, write_lines


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return make_parts(tmp_path_factory.mktemp("part"), 1, 0, seed=11)


@pytest.fixture(scope="module")
def calibration(parts: Parts) -> Calibration:
    return Calibration.load(parts.calibration)


@pytest.fixture(scope="module")
def session(parts: Parts) -> Session:
    return read_session(parts.folder / parts.good[0])


@pytest.fixture(scope="module")
def drawing(tmp_path_factory: pytest.TempPathFactory) -> Drawing:
    mesh, spec = draw_ball(tmp_path_factory.mktemp("drawn"))
    return Drawing(load_nominal(mesh), load_spec(spec))


def told(data: object) -> object:
    """Without what no two runs share: times and places."""
    if isinstance(data, Inspection):
        return told(json.loads(json_text(data.to_json_dict())))
    if isinstance(data, dict):
        return {key: told(value) for key, value in data.items() if key not in {"seconds_to_verdict", "out", "cloud", "stitch", "history"}}
    return [told(item) for item in data] if isinstance(data, list) else data


def test_a_session_is_inspected_as_its_stitched_cloud_is(parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    mesh, spec = draw_ball(tmp_path)
    folder, base = parts.folder / parts.good[0], ["inspect", mesh, "--spec", spec, "--calibration", parts.calibration, "--json", "--no-map"]

    def run(*words: object) -> tuple[int, dict[str, object]]:
        capfd.readouterr()
        code = run_app(app, [str(word) for word in words])
        printed: dict[str, object] = json.loads(capfd.readouterr().out)
        return code, printed

    assert run_app(app, ["stitch", str(parts.calibration), str(folder), "-o", str(tmp_path / "cloud.ply"), "-q"]) == 0
    place = tmp_path / "history.sqlite"
    code, apart = run(base[0], tmp_path / "cloud.ply", *base[1:], "--session", folder, "-o", tmp_path / "apart", "--history", place)
    again = run(base[0], folder, *base[1:], "-o", tmp_path / "one", "--history", place)
    assert again[0] == code
    assert told(again[1]) == told(apart)
    assert (tmp_path / "one" / CLOUD_FILE).read_bytes() == (tmp_path / "cloud.ply").read_bytes()
    assert apart["deviations"] is None
    assert not (tmp_path / "one" / "deviations.ply").exists()
    stitched = again[1]["stitch"]
    assert isinstance(stitched, dict)
    assert stitched["n_points"] == again[1]["n_points"]
    with History.open(str(place)) as history:
        kept = history.results(Calibration.load(parts.calibration).cell_name, "inspection")
    assert [row.verdict for row in kept] == [apart["verdict"]] * 2, "one of each cloud"
    for words in ([folder, mesh], [folder, *base[1:], "--session", folder], [tmp_path / "cloud.ply", mesh, "--voxel", 1]):
        code, refused = run("inspect", *words, "--json", "-o", tmp_path / "none")
        assert (code, list(refused)) == (1, ["error"])


def test_scans_that_come_one_by_one_in_any_order_make_the_same_part(calibration: Calibration, session: Session, drawing: Drawing) -> None:
    once = measure_part(calibration, session, drawing, Path("out"), StitchSettings(n_threads=1))
    growing = PartInProgress(calibration)
    for shot in reversed(scans_once(session)):
        growing.add(session, shot, read_scan(session, shot))
    came = growing.judged(session, drawing, Path("out"), began=0.0)
    np.testing.assert_array_equal(came.grid.fused().points_mm, once.grid.fused().points_mm)
    np.testing.assert_array_equal(came.grid.fused().uncertainty_mm, once.grid.fused().uncertainty_mm)
    assert told(came.inspection) == told(once.inspection)
    assert came.stitched.counts == once.stitched.counts


def test_a_picture_that_was_taken_again_leaves_nothing_of_the_first(calibration: Calibration, session: Session, drawing: Drawing) -> None:
    once = measure_part(calibration, session, drawing, Path("out"))
    growing = PartInProgress(calibration)
    first, *_ = scans_once(session)
    growing.add(session, first, read_scan(session, first))
    wrong = PointCloud(read_scan(session, first).xyz_mm + np.float32(3.0))
    growing.add(session, replace(first, index=77), wrong)
    came = growing.judged(session, drawing, Path("out"), began=0.0)
    np.testing.assert_array_equal(came.grid.fused().points_mm, once.grid.fused().points_mm)
    assert told(came.inspection) == told(once.inspection)


def test_a_region_holds_what_datums_move_a_little_and_says_so_where_they_move_more(drawing: Drawing) -> None:
    plane = {"kind": "plane", "size_mm": [40, 30]}
    features = {
        "top": {**plane, "centre_mm": [0, 0, 40], "normal": [0, 0, 1]},
        "side": {**plane, "centre_mm": [60, 0, 20], "normal": [1, 0, 0]},
        "front": {**plane, "centre_mm": [0, -40, 20], "normal": [0, -1, 0]},
    }
    place = se3.from_rotation_translation(se3.exp_so3([0.1, -0.2, 0.7]), [900.0, 100.0, 200.0])
    alignment = {"method": "datums", "primary": "top", "secondary": "side", "tertiary": "front", "base_from_part": place.tolist()}
    spec = InspectionSpec.model_validate({"format": "spherecal-inspection/1", "features": features, "alignment": alignment})
    region = region_of(spec, drawing.nominal)
    assert region is not None
    # by as much as the first search finds, and a turn that moves the ends as far
    near, far = (se3.inverse(place @ se3.exp([k * 4.0, k * -4.0, k * 4.0, 0, 0, k * 0.05])) for k in (1.0, 8.0))
    assert region.holds(near)
    assert not region.holds(far)
    assert region_of(spec.model_copy(update={"alignment": Alignment(method="best_fit")}), drawing.nominal) is None


def test_a_session_without_a_good_scan_is_refused(parts: Parts, calibration: Calibration, drawing: Drawing, tmp_path: Path) -> None:
    shutil.copytree(parts.folder / parts.good[0], tmp_path / "s")
    write_lines(tmp_path / "s", [{**line, "status": "failed", "reason": "x"} for line in read_lines(tmp_path / "s")])
    with pytest.raises(DataError, match="no good scan"):
        measure_part(calibration, read_session(tmp_path / "s"), drawing, Path("out"))
