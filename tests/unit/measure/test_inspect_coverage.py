"""Round features seen from one side: how far round, what that makes of their figures, and what is judged by them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.gauge.correlation import Correlation, Offset
from measure.inspecting.coverage import along_outline, coverage_of
from measure.inspecting.fitting import FitPoints, fit_shape
from measure.inspecting.inspection import inspect_cloud
from measure.inspecting.result import CheckResult, Inspection
from measure.inspecting.shapes import SphereShape, StadiumShape, cylinder
from measure.inspecting.uncertainty import StatedField, joint_covariance
from tests.support.machined import drawn_spec, measured_cloud
from tests.unit.measure.test_inspection import CLOUD, NOMINAL, PLACE, TRUE_PART

HOME = np.eye(4)
BOSS = cylinder(HOME, 15.0, 6.0, 2.0, 1.0)
BOSS_ONLY: dict[str, dict[str, object]] = {
    "boss": {"kind": "cylinder", "centre_mm": [62.5, 0, 64], "axis": [0, 0, 1], "diameter_mm": 22, "length_mm": 12}
}


def arc_points(arc_deg: float, n: int, rng: np.random.Generator, radius_mm: float = 15.0) -> FloatArray:
    """Of an upright cylinder, its arc about x."""
    angle = np.radians(rng.uniform(-arc_deg / 2, arc_deg / 2, n))
    return np.column_stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), rng.uniform(-6, 6, n)])


@pytest.mark.parametrize("arc_deg", [60.0, 130.0, 250.0, 360.0])
def test_coverage_is_the_arc_that_was_seen_and_strays_do_not_add_to_it(arc_deg: float) -> None:
    rng = np.random.default_rng(int(arc_deg))
    points = arc_points(arc_deg, 900, rng)
    for n_strays in (0, 12):
        seen = coverage_of(BOSS, np.concatenate([points, arc_points(360.0, n_strays, rng)]), np.zeros(5))
        assert seen is not None
        assert seen.seen_deg == pytest.approx(arc_deg, abs=12)
        assert seen.arc_deg == pytest.approx(arc_deg, abs=12)


def test_two_facing_quarters_are_half_seen_and_hold_three_quarters() -> None:
    points = arc_points(90.0, 900, np.random.default_rng(3))
    seen = coverage_of(BOSS, np.concatenate([points, points * [-1, -1, 1]]), np.zeros(5))
    assert seen is not None
    assert seen.seen_deg == pytest.approx(180, abs=21)
    assert seen.arc_deg == pytest.approx(270, abs=6)


def test_a_sphere_is_seen_over_its_cap() -> None:
    rng = np.random.default_rng(4)
    height = rng.uniform(np.cos(np.radians(50)), 1, 4000)
    angle = rng.uniform(0, 2 * np.pi, 4000)
    across = np.sqrt(1 - height**2)
    points = 10 * np.column_stack([across * np.cos(angle), across * np.sin(angle), height])
    seen = coverage_of(SphereShape(HOME, 10.0, 2.0, np.pi), points, np.zeros(4))
    assert seen is not None
    assert seen.seen_deg == pytest.approx(100, abs=4)


def test_the_way_along_a_slot_is_its_length_and_no_place_is_met_twice() -> None:
    slot = StadiumShape(HOME, 5.0, 9.0, 3.0, 3.0, -1.0, ("x", "y", "radius", "turn", "straight"))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 200)
    right = np.column_stack([9 + 5 * np.cos(angle), 5 * np.sin(angle)])
    side = np.column_stack([np.linspace(9, -9, 200), np.full(200, 5.0)])
    outline = np.concatenate([right[100:], side, -right, -side, right[:100]])
    way = along_outline(slot, np.column_stack([outline, np.zeros(len(outline))]))
    way = np.where(np.arange(len(way)) < len(way) // 2, way, way % (10 * np.pi + 36))
    steps = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    assert np.diff(way) == pytest.approx(steps, abs=0.01)


def test_one_side_of_a_boss_with_strays_round_its_back_lies_in_its_interval() -> None:
    """Smooth errors of the size stated; strays that stand off the wall, as voxels at the rim of a boss do."""
    normed = []
    for seed in range(40):
        rng = np.random.default_rng([71, seed])
        wall = arc_points(130.0, 470, rng)
        bumps = rng.uniform(-15, 15, (30, 3))
        smooth = np.exp(-((wall[:, None] - bumps) ** 2).sum(axis=2) / (2 * 8.0**2)) @ rng.normal(0, 1, 30)
        off = 0.03 * smooth / 1.4 + rng.normal(0, 0.05, len(wall))
        wall = wall * np.column_stack([1 + off / 15, 1 + off / 15, np.ones(len(wall))])
        strays = arc_points(200.0, 14, rng, 15.0 - 0.15) * [-1, 1, 1]
        points = np.concatenate([wall, strays])
        fit = fit_shape(BOSS, FitPoints(points, np.ones(len(points)), np.arange(len(points))), name="boss")
        covariance = joint_covariance([fit.response], [fit.covariance()], StatedField(0.03, ""), 0.0)
        rows = np.eye(5)[[0, 4]]
        u = np.array([np.sqrt(covariance.of(row[None])[0, 0]) for row in rows])
        normed.append(fit.params[[0, 4]] / (2 * u))
    assert np.mean(np.abs(normed) <= 1) >= 0.9
    # nor does a guess that is far too wide pass
    assert np.sqrt(np.mean(np.square(normed))) >= 0.15


def one_side_of_the_boss(arc_deg: float) -> FloatArray:
    """The cloud of the part, the wall of its boss seen over an arc alone."""
    in_part = se3.apply(se3.inverse(PLACE), CLOUD)
    way = in_part[:, :2] - TRUE_PART.boss_centre_mm
    wall = (in_part[:, 2] > TRUE_PART.step_height_mm + 0.5) & (np.abs(np.hypot(*way.T) - TRUE_PART.boss_radius_mm) < 0.5)
    return np.asarray(CLOUD[~(wall & (np.abs(np.degrees(np.arctan2(way[:, 1], way[:, 0]))) > arc_deg / 2))])


def inspected(points: FloatArray, boss: Mapping[str, object] | None = None, check: Mapping[str, object] | None = None, **more: object) -> Inspection:
    features = {"boss": {**BOSS_ONLY["boss"], **(boss or {})}}
    checks = [{"kind": "diameter", "feature": "boss", "tolerance": 0.5, **(check or {})}]
    spec = drawn_spec(features=features, checks=checks, alignment={"base_from_part": PLACE.tolist()}, point_expanded_uncertainty_mm=0.01)
    return inspect_cloud(measured_cloud(points), NOMINAL, spec, with_map=False, **more)  # type: ignore[arg-type]


def test_nothing_is_judged_by_a_feature_that_was_seen_over_a_short_arc() -> None:
    short = one_side_of_the_boss(70.0)
    result = inspected(short)
    assert result.verdict == "not_proven"
    assert "boss is seen over 6" in result.reasons[0]
    assert "of its circumference" in result.reasons[0]
    assert result.checks[0].measured is not None
    data = result.to_json_dict()["features"]
    assert isinstance(data, dict)
    assert data["boss"]["circumference_seen_deg"] == pytest.approx(67, abs=6)
    # not even a plain miss is told as such, unless the file says that this much is enough
    miss: dict[str, object] = {"nominal": 25.0, "tolerance": 0.1}
    assert inspected(short, check=miss).verdict == "not_proven"
    assert inspected(short, {"least_seen_deg": 40.0}, check=miss).verdict == "reject"
    assert inspected(CLOUD).verdict == "conform"


def corrected(offset_mm: float, *, judge_corrected: bool = False) -> CheckResult:
    offset = Offset(offset_mm, 0.03, 0.02, 5, 1.0, slope_is_one=True)
    return inspected(CLOUD, check={"tolerance": 0.2}, correlation=Correlation({"diameter boss": offset}, 2), judge_corrected=judge_corrected).checks[
        0
    ]


def test_a_correlation_is_shown_beside_the_raw_value_and_judged_only_where_asked() -> None:
    raw = inspected(CLOUD, check={"tolerance": 0.2}).checks[0]
    beside, judged = corrected(0.5), corrected(0.5, judge_corrected=True)
    assert raw.measured is not None
    assert raw.corrected is None
    for check in (beside, judged):
        assert check.measured == raw.measured
        assert check.corrected is not None
        assert check.corrected.value_mm == pytest.approx(raw.measured + 0.5)
        assert check.corrected.expanded_uncertainty_mm == pytest.approx(np.hypot(raw.expanded_uncertainty, 0.03))
    assert (raw.verdict, beside.verdict, judged.verdict) == ("conform", "conform", "reject")
    assert "corrected from" in judged.reason
    # the offset's U belongs to the corrected value: within its guard band nothing is proven
    assert corrected(0.19 - (raw.measured - 22.0), judge_corrected=True).verdict == "not_proven"


def test_a_correlation_that_names_no_tolerance_is_told() -> None:
    offset = Offset(0.1, 0.03, 0.02, 5, 1.2, slope_is_one=False)
    result = inspected(CLOUD, correlation=Correlation({"diameter boss": offset, "diameter bose": offset}))
    assert any("diameter bose" in note for note in result.notes)
    assert any("slope" in note for note in result.notes)


def test_a_rim_that_stands_in_the_wall_all_round_is_charged_to_the_diameter() -> None:
    """Points at the mouth of a bore lie off its wall on every side alike: patches side by side agree, layers do not."""
    rng = np.random.default_rng(31)
    clean = arc_points(360.0, 900, rng)
    clean[:, :2] *= (1 + rng.normal(0, 0.05, 900) / 15)[:, None]
    worn = clean.copy()
    worn[:, :2] *= np.where(clean[:, 2] > 2.0, 1 + 0.3 * (clean[:, 2] - 2.0) / 4.0 / 15, 1.0)[:, None]
    circle = StadiumShape(HOME, 15.0, 0.0, 6.0, 2.0)
    fits = [fit_shape(circle, FitPoints(points, np.ones(900), np.arange(900)), name="bore") for points in (clean, worn)]
    widths = [4 * float(np.sqrt(fit.covariance()[2, 2])) for fit in fits]
    errors = [2 * abs(float(fit.params[2])) for fit in fits]
    assert errors[0] <= widths[0] <= 0.03
    assert 0.05 <= errors[1] <= widths[1]
