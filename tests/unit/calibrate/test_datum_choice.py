"""The base of an earlier calibration: by its robot, or by spheres that stand where they stood."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from calibrate.datum import controller_datum
from calibrate.datum_choice import DatumChoice
from calibrate.report_figures import make_result
from calibrate.result import Calibration
from calibrate.solve import CalibrationSettings, Solved, solve_observations
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import one_thread
from tests.support.volume import VolumeCell, random_shots, volume_cell

SETTINGS = CalibrationSettings(camera_error="affine", robot_terms="none")
HELD = ("A", "B", "E")


@pytest.fixture(scope="module")
def volume() -> VolumeCell:
    return volume_cell(31)


def solved(volume: VolumeCell, seed: int) -> Solved:
    with one_thread():
        return solve_observations(
            random_shots(volume, volume.spheres, 8, np.random.default_rng([31, seed]), n_points=80), volume.cell, volume.model, SETTINGS
        )[0]


def stated(volume: VolumeCell, found: Solved, like: DatumChoice | None = None) -> Calibration:
    return make_result(
        found,
        method="clouds",
        cell=volume.cell,
        sessions=[],
        n_shots=48,
        notes=(),
        compared={},
        rejected=(),
        created_utc="",
        software="",
        began=0.0,
        like=like,
    )


@pytest.fixture(scope="module")
def again(volume: VolumeCell) -> Solved:
    return solved(volume, 2)


@pytest.fixture(scope="module")
def earlier(volume: VolumeCell) -> Calibration:
    """In a base that is nobody's best fit."""
    found = stated(volume, solved(volume, 1))
    aside = se3.exp([40.0, -25.0, 10.0, 0.01, -0.02, 0.3])
    centres = {name: se3.apply(aside, centre) for name, centre in found.sphere_centres_in_base_mm.items()}
    return replace(found, datum=replace(found.datum, base_from_solver=aside @ found.datum.base_from_solver), sphere_centres_in_base_mm=centres)


def differences_mm(a: Calibration, b: Calibration) -> FloatArray:
    """(k, 3) of what the camera sees at the references of a."""
    points, joints = np.tile([0.0, 0.0, 340.0], (len(a.datum.references.joints_rad), 1)), a.datum.references.joints_rad
    return a.points_in_base_mm(points, joints_rad=joints) - b.points_in_base_mm(points, joints_rad=joints)


def lengths_mm(c: Calibration) -> FloatArray:
    return np.array([np.linalg.norm(a - b) for a, b in combinations(c.sphere_centres_in_base_mm.values(), 2)])


@pytest.mark.parametrize("spheres", [(), HELD])
def test_results_are_in_the_earlier_base_and_no_length_changes(
    volume: VolumeCell, earlier: Calibration, again: Solved, spheres: tuple[str, ...]
) -> None:
    own, like = stated(volume, again), stated(volume, again, DatumChoice(earlier, spheres))
    assert np.linalg.norm(differences_mm(own, earlier), axis=1).min() > 10
    assert np.sqrt((differences_mm(like, earlier) ** 2).sum(axis=1).mean()) < 0.15
    np.testing.assert_allclose(lengths_mm(like), lengths_mm(own), atol=1e-9)
    assert like.datum.like == earlier.id
    assert like.id != own.id


def test_laid_on_spheres_they_stand_where_they_stood_as_nearly_as_a_rigid_body_can(volume: VolumeCell, earlier: Calibration, again: Solved) -> None:
    like = stated(volume, again, DatumChoice(earlier, HELD))
    ends = [np.array([c.sphere_centres_in_base_mm[name] for name in HELD]) for c in (like, earlier)]
    np.testing.assert_allclose(se3.fit_rigid(*ends), np.eye(4), atol=1e-9)


def test_the_base_follows_the_spheres_that_hold_it(volume: VolumeCell, earlier: Calibration, again: Solved) -> None:
    """At the middle of the spheres little is left to be uncertain of, and far from them what a turn about them moves."""
    own, like = stated(volume, again), stated(volume, again, DatumChoice(earlier, HELD))
    middle = np.mean([own.sphere_centres_in_base_mm[name] for name in HELD], axis=0)
    joints = own.datum.references.joints_rad
    seen = own.points_in_base_mm(np.tile([0.0, 0.0, 340.0], (len(joints), 1)), joints_rad=joints)
    near = joints[np.argsort(np.linalg.norm(seen - middle, axis=1))[:8]]

    def sigma_mm(c: Calibration) -> float:
        jacobian = c.point_jacobian(np.tile([0.0, 0.0, 340.0], (8, 1)), joints_rad=near).mean(axis=0)
        p = jacobian.shape[-1]
        return float(np.sqrt(np.trace(jacobian @ c.covariance[:p, :p] @ jacobian.T)))

    assert sigma_mm(like) < sigma_mm(own)
    # the noise of the spheres' own shots is in the covariance of a point, and is a small part of it
    point = np.array([[0.0, 0.0, 340.0]])
    with_noise = np.trace(like.point_covariance_in_base_mm2(point, joints_rad=near[0])[0])
    without = np.trace(replace(like, datum=replace(like.datum, noise=None)).point_covariance_in_base_mm2(point, joints_rad=near[0])[0])
    assert without < with_noise < 1.5 * without


def test_a_stated_base_outlives_its_file(volume: VolumeCell, earlier: Calibration, again: Solved, tmp_path: Path) -> None:
    like = stated(volume, again, DatumChoice(earlier, HELD))
    like.save(tmp_path / "c.yaml")
    read, joints = Calibration.load(tmp_path / "c.yaml"), np.zeros(6)
    assert (read.datum.kind, read.datum.like, read.datum.spheres) == ("spheres", earlier.id, HELD)
    point = np.array([[10.0, 5.0, 330.0]])
    np.testing.assert_array_equal(
        read.point_covariance_in_base_mm2(point, joints_rad=joints), like.point_covariance_in_base_mm2(point, joints_rad=joints)
    )


def test_what_cannot_hold_a_base_is_told(volume: VolumeCell, earlier: Calibration, again: Solved) -> None:
    for spheres, told in {("A", "B"): "three or more", ("A", "B", "nobody"): "nobody"}.items():
        with pytest.raises(SettingsError, match=told):
            stated(volume, again, DatumChoice(earlier, spheres))
    a, b = (earlier.sphere_centres_in_base_mm[name] for name in "AB")
    in_line = replace(earlier, sphere_centres_in_base_mm={"A": a, "B": b, "C": (a + b) / 2})
    with pytest.raises(SettingsError, match="not in line"):
        stated(volume, again, DatumChoice(in_line, ("A", "B", "C")))
    for robotless in (replace(earlier, model=None), replace(earlier, datum=controller_datum())):
        with pytest.raises(SettingsError, match="holds none"):
            stated(volume, again, DatumChoice(robotless))
