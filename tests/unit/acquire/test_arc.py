"""Arcs in line profiles: exact cuts, clutter, refusals, and the real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acquire.sphere import SphereNotFound, SphereSettings, find_arc
from drivers.files.session import read_scan, read_session

RADIUS = 40.0


def profile(*, beside_mm: float = 10.0, noise_mm: float = 0.011, seed: int = 0, up: float = -1.0) -> np.ndarray:
    """(n, 3) cut of the sphere at a distance beside its centre, over a flat table; `up` -1: z points away from the sensor."""
    rng = np.random.default_rng(seed)
    centre = (5.0, 250.0)
    x = np.linspace(-90, 90, 2400)
    radius = np.sqrt(RADIUS**2 - beside_mm**2)
    height = np.sqrt(np.maximum(radius**2 - (x - centre[0]) ** 2, 0.0))
    on_it = np.abs(x - centre[0]) < 0.97 * radius
    z = np.where(on_it, centre[1] + up * height, centre[1] - up * 45.0) + rng.normal(0, noise_mm, len(x))
    return np.column_stack([x, np.zeros_like(x), z])


@pytest.mark.parametrize("beside_mm", [0.0, 10.0, 34.0])
@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_cut_is_found_over_a_table(beside_mm: float, up: float) -> None:
    finding = find_arc(profile(beside_mm=beside_mm, up=up), radius_mm=RADIUS)
    radius = np.sqrt(RADIUS**2 - beside_mm**2)
    assert finding.arc_radius_mm == pytest.approx(radius, abs=0.01)
    np.testing.assert_allclose(finding.arc_centre_in_camera_mm, [5.0, 0.0, 250.0], atol=0.01)
    assert finding.rms_mm == pytest.approx(0.011, rel=0.2)
    leaning = np.degrees(np.arcsin(np.abs(finding.points_in_camera_mm[:, 0] - 5.0) / radius))
    assert leaning.max() < np.degrees(SphereSettings().max_arc_angle_rad) + 0.5
    assert leaning.max() > np.degrees(SphereSettings().max_arc_angle_rad) - 2


def test_outliers_do_not_matter_and_indices_lead_back() -> None:
    points = profile()
    rng = np.random.default_rng(4)
    wild = rng.uniform(size=len(points)) < 0.2
    points[wild, 2] += rng.uniform(-30, 30, wild.sum())
    finding = find_arc(points, radius_mm=RADIUS)
    np.testing.assert_array_equal(points[finding.indices], finding.points_in_camera_mm)
    np.testing.assert_allclose(finding.arc_centre_in_camera_mm, [5.0, 0.0, 250.0], atol=0.02)


def test_the_order_of_the_points_changes_nothing() -> None:
    points = profile()
    order = np.random.default_rng(1).permutation(len(points))
    first, second = find_arc(points, radius_mm=RADIUS), find_arc(points[order], radius_mm=RADIUS)
    assert set(order[second.indices]) == set(first.indices)


def flat() -> np.ndarray:
    x = np.linspace(-90, 90, 2400)
    return np.column_stack([x, 0 * x, 300 + np.random.default_rng(0).normal(0, 0.01, len(x))])


@pytest.mark.parametrize(
    ("points", "reasons"),
    [
        (np.full((100, 3), np.nan), {"no_points"}),
        (profile()[:20], {"too_few_points"}),
        (profile() / 1000, {"unit_metres"}),
        (profile()[:, [0, 2, 1]], {"not_a_profile"}),
        (flat(), {"no_arc", "radius", "coverage"}),
    ],
)
def test_refusals_name_their_reason(points: np.ndarray, reasons: set[str]) -> None:
    with pytest.raises(SphereNotFound) as caught:
        find_arc(points, radius_mm=RADIUS)
    assert caught.value.reason in reasons


@pytest.mark.parametrize("name", ["r40_a", "r40_b"])
def test_every_real_arc_is_found(real_data: Path, name: str) -> None:
    session = read_session(real_data / "line_scanner" / name)
    findings = [find_arc(read_scan(session, shot).xyz_mm, radius_mm=RADIUS) for shot in session.shots]
    assert len(findings) == 15
    assert max(finding.rms_mm for finding in findings) < 0.013
    assert min(finding.n_points for finding in findings) > 900
    assert all(20 < finding.arc_radius_mm < 40.0 for finding in findings)
