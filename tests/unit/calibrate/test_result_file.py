"""calibration.yaml: comes back as it was, tells of every edit, and never breaks with anything but a FileError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate import Calibration
from calibrate.result_file import calibration_data, content_id
from drivers.errors import FileError
from drivers.files.yaml import dump_yaml, load_yaml

Place = tuple[str | int, ...]
ODD: list[object] = ["delete", None, "text", 1.5, [], {}, [1.0, "x"], -3, True, [[1.0, 2.0], [3.0]]]


@pytest.fixture(scope="module")
def text(calibration: Calibration, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("file") / "c.yaml"
    calibration.save(path)
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def small(calibration: Calibration) -> dict[str, Any]:
    """The data of a calibration cut to what reads fast: two shots, a covariance of three parameters."""
    names = calibration.parameter_names[:3]
    return dict(calibration_data(replace(calibration, shots=calibration.shots[:2], covariance=calibration.covariance[:3, :3], parameter_names=names)))


def same(a: object, b: object) -> bool:
    """Whether two results hold the same, arrays included."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(np.asarray(a), np.asarray(b))
    if is_dataclass(a) and not isinstance(a, type):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.name not in {"seconds", "text"})
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


@pytest.mark.parametrize("pose_only", [False, True])
def test_what_is_saved_is_loaded(pose_only: bool, calibration: Calibration, pose_only_calibration: Calibration, tmp_path: Path) -> None:
    c = pose_only_calibration if pose_only else calibration
    c.save(tmp_path / "c.yaml")
    again = Calibration.load(tmp_path / "c.yaml")
    # what is worked out on the way belongs to no file
    different = [f.name for f in fields(c) if f.init and not same(getattr(c, f.name), getattr(again, f.name))]
    assert not different
    assert again.id == c.id
    again.save(tmp_path / "d.yaml")
    assert (tmp_path / "d.yaml").read_bytes() == (tmp_path / "c.yaml").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.yaml", "d.yaml"]


def test_a_loaded_calibration_measures_the_same(calibration: Calibration, text: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    again = Calibration.load(str(tmp_path / "c.yaml"))
    points, joints = np.array([[10.0, -20.0, 300.0], [-60.0, 40.0, 260.0]]), np.array([0.2, -0.5, 0.1, -0.3, -1.2, 2.0])
    np.testing.assert_array_equal(again.points_in_base_mm(points, joints_rad=joints), calibration.points_in_base_mm(points, joints_rad=joints))
    np.testing.assert_array_equal(
        again.point_covariance_in_base_mm2(points, joints_rad=joints), calibration.point_covariance_in_base_mm2(points, joints_rad=joints)
    )


def test_the_id_is_of_the_content_and_not_of_the_hour(small: dict[str, Any]) -> None:
    for key, value in (("created_utc", "2031-01-01T00:00:00Z"), ("software", "spherecal 99"), ("id", "x")):
        assert content_id(small | {key: value}) == small["id"]
    for key in set(small) - {"id", "created_utc", "software"}:
        assert content_id(small | {key: "other"}) != small["id"], key
    assert content_id(dict(reversed(small.items()))) == small["id"]


def places(data: object, at: Place = ()) -> Iterator[Place]:
    """Where every value sits that holds no others, and every mapping and list."""
    if at:
        yield at
    members = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in members:
        yield from places(value, (*at, key))


def changed(data: Any, at: Place, value: object = None, *, delete: bool = False) -> Any:
    """A copy of data with one value changed or deleted."""
    copy: Any = dict(data) if isinstance(data, dict) else list(data)
    if len(at) > 1:
        copy[at[0]] = changed(data[at[0]], at[1:], value, delete=delete)
    elif delete:
        del copy[at[0]]
    else:
        copy[at[0]] = value
    return copy


def get(data: Any, at: Place) -> object:
    for key in at:
        data = data[key]
    return data


def written(data: object, folder: Path) -> Path:
    path = folder / "c.yaml"
    path.write_text(dump_yaml(data), encoding="utf-8")
    return path


@settings(max_examples=40)
@given(data=st.data())
def test_every_edited_value_is_refused(data: st.DataObject, small: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> None:
    ignored = {"id", "created_utc", "software"}
    leaves = [at for at in places(small) if not isinstance(get(small, at), dict | list) and at[0] not in ignored]
    at = data.draw(st.sampled_from(leaves))
    value = get(small, at)
    edited = value + 1e-9 * max(1.0, abs(value)) if isinstance(value, float) else f"{value} or so"
    path = written(changed(small, at, edited), tmp_path_factory.mktemp("edited"))
    with pytest.raises(FileError) as told:
        Calibration.load(path)
    assert told.value.remedy
    assert str(path) in str(told.value)


@settings(max_examples=60)
@given(data=st.data())
def test_a_missing_or_odd_value_with_a_right_id_is_a_file_error_or_harmless(
    data: st.DataObject, small: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Somebody's own script wrote the file: whatever is missing, nothing but FileError may come out."""
    at = data.draw(st.sampled_from(list(places(small))))
    odd: object = data.draw(st.sampled_from(ODD))
    broken = changed(small, at, odd, delete=odd == "delete")
    with suppress(KeyError):
        broken["id"] = content_id(broken)
    path = written(broken, tmp_path_factory.mktemp("odd"))
    with suppress(FileError):
        assert isinstance(Calibration.load(path), Calibration)


def test_keys_that_the_result_is_built_from_are_asked_for(small: dict[str, Any], tmp_path: Path) -> None:
    # the last ones are sections that files of older versions lack
    not_read = {("parameters", "sigma"), ("id",), ("format",), ("identifiability",), ("next_best_poses",), ("error_budget",), ("temperatures_c",)}
    not_read |= {("camera_error", "seen_cells"), ("datum", "reference_points_in_flange_mm")}
    needed = [at for at in places(small) if len(at) <= 2 and isinstance(at[-1], str) and at not in not_read and at[0] not in {"inputs", "identity"}]
    for at in needed:
        if at[0] in {"robot_model", "limits"} and len(at) == 2:
            continue  # their own schemas say what is optional
        if len(at) == 2 and at[0] == "spheres":
            continue  # one sphere fewer is a calibration too
        broken = changed(small, at, delete=True)
        broken["id"] = content_id(broken)
        with suppress(FileError):
            Calibration.load(written(broken, tmp_path))
            # statistics have defaults for what older files do not hold
            assert at[0] in {"statistics", "noise"}, at


@settings(max_examples=25)
@given(share=st.floats(0.0, 0.999))
def test_a_file_that_is_cut_off_is_a_file_error(share: float, text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("cut") / "c.yaml"
    path.write_text(text[: int(share * (len(text) - 2))], encoding="utf-8")
    with pytest.raises(FileError) as told:
        Calibration.load(path)
    assert told.value.remedy


def test_other_files_are_named_as_what_they_are_not(tmp_path: Path) -> None:
    for content in ("format: spherecal-cell/1\nname: x\n", "[1, 2]\n", "5\n"):
        path = tmp_path / "other.yaml"
        path.write_text(content, encoding="utf-8")
        with pytest.raises(FileError, match="is no calibration"):
            Calibration.load(path)
    with pytest.raises(FileError):
        Calibration.load(tmp_path / "missing.yaml")
    with pytest.raises(FileError):
        Calibration.load(tmp_path)


def test_a_place_that_cannot_be_written_is_a_file_error(calibration: Calibration, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(FileError):
        calibration.save(tmp_path / "file" / "c.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_the_file_can_be_read_by_a_person(text: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    data = load_yaml(tmp_path / "c.yaml")
    assert isinstance(data, dict)
    assert list(data)[:2] == ["format", "id"]
    assert {"robot_model", "link_twists", "robot_terms", "flange_from_camera", "camera_error", "spheres", "datum", "limits", "verdict"} <= set(data)
    assert {"inputs", "identity", "seen_axis_ranges_rad", "parameters", "statistics", "reasons", "shots", "rejected"} <= set(data)
    assert len(text) < 400_000
