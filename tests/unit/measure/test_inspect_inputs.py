"""What an inspection is given: spoiled clouds, spoiled meshes, wrong units, wrong specs; told or handled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.errors import DataError, FileError
from drivers.files.ply import write_ply
from drivers.kinematics.se3 import FloatArray
from drivers.registry import hardware_remark
from drivers.simulated.workpiece_machined import MachinedPart
from measure.inspecting.cloud import load_cloud
from measure.inspecting.distance import NominalSurface
from measure.inspecting.inspection import inspect_cloud
from measure.inspecting.nominal import Nominal, load_nominal
from measure.inspecting.spec import InspectionSpec, load_spec
from measure.inspecting.units import require_features_on, require_likely_units
from tests.support.machined import drawn_spec, measured_cloud, nominal_of

BOX = (60.0, 40.0, 20.0)


def box_points(n: int, rng: np.random.Generator) -> FloatArray:
    """On the top of the box."""
    return np.column_stack([rng.uniform(-30, 30, n), rng.uniform(-20, 20, n), np.full(n, 10.0)])


def box_mesh(spoil: Callable[[trimesh.Trimesh], None] | None = None) -> trimesh.Trimesh:
    mesh: trimesh.Trimesh = trimesh.creation.box(BOX).subdivide().subdivide()
    if spoil is not None:
        spoil(mesh)
    return mesh


def loaded(folder: Path, mesh: trimesh.Trimesh, suffix: str = "stl") -> Nominal:
    path = folder / f"part.{suffix}"
    mesh.export(path)
    return load_nominal(path)


CLOUDS: dict[str, tuple[FloatArray, list[str], str]] = {
    "empty": (np.zeros((0, 3)), [], "holds no points"),
    "single point": (np.array([[1.0, 2, 3]]), [], "1 finite points of 1"),
    "all NaN": (np.full((500, 3), np.nan), [], "0 finite points of 500"),
    "nearly all NaN": (np.concatenate([np.full((500, 3), np.nan), np.ones((50, 3))]), [], "50 finite points of 550"),
    "huge": (np.full((500, 3), 1e12), [], "km away"),
    "metres told": (np.ones((500, 3)), ["unit m"], "unit m"),
    "a scan": (np.ones((500, 3)), ["unit mm", "frame camera"], "camera frame"),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_a_cloud_that_cannot_be_inspected_is_told(name: str, tmp_path: Path) -> None:
    points, comments, words = CLOUDS[name]
    write_ply(tmp_path / "cloud.ply", points, comments=comments)
    with pytest.raises((DataError, FileError), match=words):
        load_cloud(tmp_path / "cloud.ply")


def test_nan_rows_and_far_points_are_dropped_and_what_the_file_states_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    points = box_points(600, rng)
    points[::3] = np.nan
    points[1] = 1e9
    columns = {
        "nx": np.zeros(600),
        "ny": np.zeros(600),
        "nz": np.full(600, 0.9),
        "count": np.arange(600, dtype=np.uint32),
        "uncertainty": np.full(600, 0.03),
    }
    comments = ["unit mm", "frame base", "calibration abc", "drivers ur_rtde simulated", "voxel_mm 0.5"]
    write_ply(tmp_path / "cloud.ply", points, properties=columns, comments=comments)
    cloud = load_cloud(tmp_path / "cloud.ply")
    assert len(cloud.points_mm) == 399
    assert cloud.standard_uncertainty_mm == pytest.approx(0.03)
    assert (cloud.calibration_id, cloud.voxel_mm) == ("abc", 0.5)
    assert cloud.weights.tolist() == [i for i in range(600) if i % 3 and i != 1]
    assert cloud.normals is not None
    assert cloud.normals[:, 2].tolist() == [1.0] * 399
    assert "dropped" in cloud.notes[0]
    assert cloud.notes[1:] == (hardware_remark("ur_rtde"),)


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1e-3, "the cloud is probably in metres"),
        (1e3, "the nominal is probably in metres"),
        (25.4, "inches"),
        (10.0, "nominal is probably in centi"),
        (0.1, "cloud is probably in centi"),
    ],
)
def test_units_that_differ_between_cloud_and_nominal_are_told(scale: float, words: str, tmp_path: Path) -> None:
    corners = np.random.default_rng(2).uniform(-0.5, 0.5, (4000, 3)) * BOX
    with pytest.raises(DataError, match=words):
        require_likely_units(measured_cloud(corners * scale * 1.01), loaded(tmp_path, box_mesh()))


@pytest.mark.parametrize(("scale", "words"), [(1 / 25.4, "in inches"), (0.1, "in centimetres"), (1.0, None)])
def test_features_that_do_not_lie_on_the_mesh_are_told(scale: float, words: str | None) -> None:
    drawn = nominal_of(MachinedPart(), 24)
    mesh = replace(drawn, vertices_mm=drawn.vertices_mm * scale)
    if words is None:
        require_features_on(mesh, drawn_spec())
        return
    with pytest.raises(FileError, match=words):
        require_features_on(mesh, drawn_spec())


def _invert(mesh: trimesh.Trimesh) -> None:
    mesh.invert()


def _turn_some(mesh: trimesh.Trimesh) -> None:
    faces = np.array(mesh.faces)
    faces[::5] = faces[::5][:, ::-1]
    mesh.faces = faces


def _open(mesh: trimesh.Trimesh) -> None:
    kept = mesh.triangles_center[:, 2] < 9.9
    kept[np.flatnonzero(~kept)[8:]] = True
    mesh.update_faces(kept)


@pytest.mark.parametrize(("spoil", "words"), [(None, None), (_invert, "192 of 192 faces"), (_turn_some, "39 of 192 faces"), (_open, "holes")])
@pytest.mark.parametrize("suffix", ["stl", "ply", "obj"])
def test_flipped_faces_are_turned_and_holes_are_told(
    spoil: Callable[[trimesh.Trimesh], None] | None, words: str | None, suffix: str, tmp_path: Path
) -> None:
    nominal = loaded(tmp_path, box_mesh(spoil), suffix)
    assert (words is None and not nominal.notes) or (words is not None and words in nominal.notes[0])
    found = NominalSurface.of(nominal).nearest(np.array([[0.0, 0, -13], [0, 0, -8], [31, 0, 0]]))
    np.testing.assert_allclose(found.signed_mm, [3, -2, 1], atol=1e-6)


def test_distances_from_a_box_are_the_formulas_at_faces_edges_and_corners(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (4000, 3)) * np.array(BOX) * 0.75
    past = np.abs(points) - np.array(BOX) / 2
    outside = np.linalg.norm(np.maximum(past, 0), axis=1)
    expected = np.where(outside > 0, outside, past.max(axis=1))
    found = NominalSurface.of(loaded(tmp_path, box_mesh())).nearest(points)
    np.testing.assert_allclose(found.signed_mm, expected, atol=1e-5)
    assert not found.at_border.any()


def test_points_over_a_hole_of_the_mesh_are_left_out_of_the_deviations(tmp_path: Path) -> None:
    cloud = measured_cloud(box_points(3000, np.random.default_rng(4)))
    whole, open_ = (
        inspect_cloud(cloud, loaded(tmp_path, box_mesh(spoil)), InspectionSpec(format="spherecal-inspection/1")).deviations for spoil in (None, _open)
    )
    assert whole is not None
    assert open_ is not None
    assert whole.n_left_out == 0
    assert open_.n_left_out > 300
    assert np.abs(open_.signed_mm).max() < 1e-4


NO_MESHES = {
    "part.stl": (b"", "cannot be read|no triangles"),
    "part.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "cannot be read|no triangles"),
    "part.obj": (b"v 0 0 0\n", "cannot be read|no triangles"),
    "part.step": (b"ISO-10303-21;", "STL"),
    "part.docx": (b"x", "no mesh"),
}


@pytest.mark.parametrize("name", NO_MESHES)
def test_what_is_no_mesh_is_told(name: str, tmp_path: Path) -> None:
    content, words = NO_MESHES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=words):
        load_nominal(tmp_path / name)


def test_a_mesh_in_metres_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="metres"):
        loaded(tmp_path, trimesh.creation.box([0.06, 0.04, 0.02]))


def test_a_cloud_of_something_else_is_told() -> None:
    cloud = measured_cloud(box_points(3000, np.random.default_rng(5)) + np.array([0, 0, 400]))
    with pytest.raises(DataError, match="within 5 mm of the nominal"):
        inspect_cloud(cloud, nominal_of(MachinedPart(), 24), drawn_spec(features={}))


SPECS = {
    "checks: [{kind: diameter, feature: nobody, tolerance: 1}]": "nobody",
    "checks: [{kind: diameter, feature: top}]": "tolerance",
    "checks: [{kind: diameter, feature: top, lower: 1, upper: 0}]": "lower must be less",
    "checks: [{kind: position, feature: top, lower: 0, upper: 1}]": "takes tolerance",
    "alignment: {method: datums, primary: top}": "primary, secondary and tertiary",
    "alignment: {method: best_fit, primary: top, secondary: top, tertiary: top}": "no other method",
    "point_expanded_uncertainty_mm: -1": "greater than 0",
    "colour: red": "unknown key",
}


@pytest.mark.parametrize("line", SPECS)
def test_a_wrong_spec_is_told_with_its_place(line: str, tmp_path: Path) -> None:
    text = "format: spherecal-inspection/1\nfeatures:\n  top: {kind: plane, centre_mm: [0, 0, 1], normal: [0, 0, 1], size_mm: [9, 9]}\n"
    (tmp_path / "inspection.yaml").write_text(text + line + "\n", encoding="utf-8")
    with pytest.raises(FileError, match=SPECS[line]):
        load_spec(tmp_path / "inspection.yaml")


def test_a_check_of_what_a_feature_does_not_have_is_told() -> None:
    cloud, nominal = measured_cloud(box_points(3000, np.random.default_rng(6))), nominal_of(MachinedPart(), 24)
    for check in ({"kind": "diameter", "feature": "top"}, {"kind": "flatness", "feature": "bore"}, {"kind": "width", "feature": "boss"}):
        with pytest.raises(FileError, match="checks"):
            inspect_cloud(cloud, nominal, drawn_spec(checks=[{**check, "tolerance": 0.1}]))
