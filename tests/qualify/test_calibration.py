"""The whole-cloud solver against its first-order bound and its own intervals, full counts, seeds and figures printed."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from calibrate.observations import Observations, SphereShot
from calibrate.result import Calibration
from drivers.kinematics.se3 import FloatArray
from tests.qualify.test_design import chosen_or_random
from tests.support.bound import recover
from tests.support.unseen import random_unseen_lengths
from tests.support.volume import UNSEEN, calibrated, observed, random_shots, volume_cell

pytestmark = pytest.mark.qualify

N_RECOVERIES, N_COVERAGES = 10, 200


@pytest.mark.parametrize("coupled", [False, True], ids=["irb1410_paper", "abb_irb1410"])
def test_held_out_centre_rms_is_at_most_a_quarter_above_the_bound(coupled: bool) -> None:
    """Issue 2: 100 random poses, 1000 points a shot, a guess 2 mm and 7 mrad off, METHOD.md 4's pose law."""
    ratios = []
    for seed in range(N_RECOVERIES):
        found = recover(seed, coupled=coupled, n_shots=100, n_points=1000, n_tests=60)
        noise = found.solution.noise
        ratios.append(found.ratio)
        print(
            f"\nqualify recovery coupled={coupled} seed={seed}: held-out {found.held_out_rms_mm:.4f} mm, bound {found.bound_mm:.4f} mm, "
            f"ratio {found.ratio:.2f}, pose noise {noise.pose_mm:.4f} mm {noise.pose_rad:.2e} rad, {found.solution.passes} passes",
            end="",
        )
    print(f"\nqualify recovery coupled={coupled}: median ratio {np.median(ratios):.3f}, largest {max(ratios):.2f}", end="")
    assert np.median(ratios) <= 1.25


def test_intervals_of_unseen_lengths_cover_95_percent(tmp_path: Path) -> None:
    """The solver's own kind of cell: random MDH errors, pillow, a sphere that reads large; two lengths a calibration.

    The covariance itself must cover 95 %. What is stated covers more, because held-out shots may widen the covariance
    and never narrow it: 98.5 % over these seeds. Over seeds 7000 to 7029, 8 lengths each: 95.4 % before, 97.9 % stated; sigma
    was widened by 1.03 in the median and by 2.3 at most.
    """
    lengths = []
    for seed in range(N_COVERAGES):
        lengths += random_unseen_lengths(1000 + seed, tmp_path / str(seed), n_shots=60, n_points=200, n_lengths=2)
    z = np.array([one.error_mm / one.sigma_mm for one in lengths])
    plain_z = np.array([one.error_mm / one.plain_sigma_mm for one in lengths])
    covered, plainly_covered = float((np.abs(z) <= 1.96).mean()), float((np.abs(plain_z) <= 1.96).mean())
    print(
        f"\nqualify coverage seeds=1000..{999 + N_COVERAGES}: {100 * covered:.1f} % of {len(z)} lengths, rms z {np.sqrt((z**2).mean()):.2f}, "
        f"before widening {100 * plainly_covered:.1f} %, rms z {np.sqrt((plain_z**2).mean()):.2f}, "
        f"median sigma {np.median([one.sigma_mm for one in lengths]):.3f} mm, rms error {np.sqrt(np.mean([o.error_mm**2 for o in lengths])):.3f} mm",
        end="",
    )
    assert 0.92 <= plainly_covered <= 0.98
    assert plainly_covered <= covered <= 0.995


N_RECALIBRATIONS = 20


def test_recalibrations_hardly_move_a_point_by_more_than_its_uncertainty() -> None:
    """The stated base: 20 calibrations of one cell, other random poses each time, seen at places that none of them saw.

    U covers 95 %, and a motion has the scatter of two calibrations in it, so that not every one of 26000 motions can stay
    below. Measured: 99.8 % do here, the largest is 1.22 U; all of two other cells with 10 calibrations, the largest 0.96 U.
    """
    volume = volume_cell(4242, "bar3")
    test = random_shots(volume, tuple(UNSEEN), 4, np.random.default_rng(4242), noise=False, n_points=5)
    places, expanded = [], []
    for seed in range(N_RECALIBRATIONS):
        shots = random_shots(volume, volume.spheres, 15, np.random.default_rng([4242, seed]), n_points=300)
        found = calibrated(volume, shots)
        # a few points at the rim of a cap are not kept, so that shots differ in their number
        places.append(np.concatenate([found.points_in_base_mm(shot.points_in_camera_mm, joints_rad=shot.joints_rad) for shot in test.shots]))
        covariance = [found.point_covariance_in_base_mm2(shot.points_in_camera_mm, joints_rad=shot.joints_rad) for shot in test.shots]
        expanded.append(2 * np.sqrt(np.linalg.eigvalsh(np.concatenate(covariance))[:, -1]))
    where = np.array(places)
    pairs = list(combinations(range(N_RECALIBRATIONS), 2))
    moved = np.array([np.linalg.norm(where[a] - where[b], axis=-1) for a, b in pairs])
    stated = np.array([np.minimum(expanded[a], expanded[b]) for a, b in pairs])
    share = moved / stated
    print(
        f"\nqualify datum: largest motion {moved.max():.3f} mm, of its U {share.max():.2f}, median U {np.median(stated):.3f} mm, "
        f"{100 * (share <= 1).mean():.2f} % within U, median {np.median(share):.2f} U",
        end="",
    )
    assert (share <= 1.0).mean() >= 0.99
    assert share.max() <= 1.5


PLANNED_SEED, N_PLANNED, LARGEST_MOTION_MM = 9190, 120, 0.03


def test_recalibrations_with_the_first_session_move_no_feature_by_more_than_0_03_mm() -> None:
    """As a plant does it where `check` finds nothing changed: the same plan anew, calibrated together with the first session.

    Features are spheres at places that no calibration sees, of six views each. What moves them is the robot's
    repeatability, shared out by the shots: alone, 120 chosen shots leave up to 0.04 mm and 300 up to 0.032.
    """
    joints, spheres, volume, _ = chosen_or_random(PLANNED_SEED, N_PLANNED, "chosen")
    test = random_shots(volume, tuple(UNSEEN), 6, np.random.default_rng(PLANNED_SEED), noise=False, n_points=50)

    def session(number: int) -> tuple[SphereShot, ...]:
        rng = np.random.default_rng([PLANNED_SEED, number])
        numbered = enumerate(zip(joints, spheres, strict=True), start=N_PLANNED * number)
        return tuple(replace(observed(volume, name, q, rng, index=i, n_points=300), session=f"s{number}") for i, (q, name) in numbered)

    first, features, expanded = session(0), [], []
    for number in range(1, N_RECALIBRATIONS + 1):
        found = calibrated(volume, Observations(first + session(number), ()))
        places, uncertainties = zip(*(_feature(found, [s for s in test.shots if s.sphere == name]) for name in UNSEEN), strict=True)
        features.append(places)
        expanded.append(uncertainties)
    where = np.array(features)
    moved = np.linalg.norm(where - where.mean(axis=0), axis=-1)
    share = (moved / np.array(expanded)).max()
    print(f"\nqualify datum, one plan: rms {np.sqrt((moved**2).mean()):.4f} mm, largest {moved.max():.4f} mm, of its U {share:.2f}", end="")
    assert share <= 1.0
    assert moved.max() <= LARGEST_MOTION_MM


def _feature(calibration: Calibration, views: list[SphereShot]) -> tuple[FloatArray, float]:
    """Place (3,) of a sphere's centre as some views measure it together, and its U in the worst direction."""
    places, jacobians = [], []
    for shot in views:
        assert shot.centre_in_camera_mm is not None
        point = shot.centre_in_camera_mm[None]
        places.append(calibration.points_in_base_mm(point, joints_rad=shot.joints_rad)[0])
        jacobians.append(calibration.point_jacobian(point, joints_rad=shot.joints_rad)[0])
    jacobian = np.mean(jacobians, axis=0)
    used = calibration.covariance[: jacobian.shape[-1], : jacobian.shape[-1]]
    return np.mean(places, axis=0), 2 * float(np.sqrt(np.linalg.eigvalsh(jacobian @ used @ jacobian.T)[-1]))
