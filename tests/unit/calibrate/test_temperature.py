"""Certified sizes at the temperature of the shots: laws of the correction, and a warm bar from session to verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import CertifiedLength, Sphere
from calibrate import Calibration
from calibrate.solve import CalibrationSettings, calibrate
from calibrate.temperature import (
    Temperature,
    artefact_temperature,
    artefact_when_seen,
    growth,
    temperature_changes,
    temperature_ranges_c,
)
from drivers.errors import DataError
from drivers.files.session import Session, Shot, read_session
from measure.verify import verify
from tests.support.recorded import TrueSystem
from tests.support.solving import noise_free
from tests.support.synthetic import SyntheticShot, paper_cell
from tests.support.synthetic_session import warm, write_session

STEEL = 11.5e-6
PLACES = {"A": (900.0, 250.0, 300.0), "B": (900.0, -250.0, 300.0)}
celsius = st.floats(-10.0, 50.0)
ctes = st.floats(1e-7, 3e-5)
lengths_mm = st.floats(50.0, 2000.0)


def session(readings_c: Sequence[Mapping[str, float]], spheres: Sequence[str] = ("A", "B"), status: str = "ok") -> Session:
    """A session in memory in which every sphere is seen once a reading."""
    shots = [
        Shot(index=i, sphere=name, status=status, temperatures_c=reading)
        for i, (reading, name) in enumerate((r, n) for r in readings_c for n in spheres)
    ]
    return Session(Path("s"), "calibration", "", "", {}, tuple(shots), tuple(shots), "0" * 64, Path("cell.yaml"))


def bar(
    length_mm: float = 500.0, cte_per_k: float | None = STEEL, reference_c: float = 20.0, between: tuple[str, str] = ("A", "B")
) -> CertifiedLength:
    return CertifiedLength(
        between=between, length_mm=length_mm, expanded_uncertainty_mm=0.004, cte_per_k=cte_per_k, reference_temperature_c=reference_c
    )


def ball(cte_per_k: float | None = None) -> Sphere:
    return Sphere(diameter_mm=38.1, expanded_uncertainty_mm=0.001, cte_per_k=cte_per_k)


@given(celsius)
def test_nothing_changes_without_a_coefficient(at_c: float) -> None:
    spheres, lengths = {"A": ball(), "B": ball()}, (bar(cte_per_k=None),)
    seen = artefact_when_seen(spheres, lengths, [session([{"artefact": at_c}])], used_together=True)
    assert (seen.spheres, seen.lengths, seen.notes) == (spheres, lengths, ())


@given(lengths_mm, ctes, celsius, celsius)
def test_the_correction_is_exact_and_made_once(length_mm: float, cte: float, reference_c: float, at_c: float) -> None:
    told = session([{"artefact": at_c}])
    spheres = {"A": ball(cte), "B": ball()}
    seen = artefact_when_seen(spheres, [bar(length_mm, cte, reference_c)], [told])
    assert seen.lengths[0].length_mm == pytest.approx(length_mm * (1 + cte * (at_c - reference_c)), rel=1e-14)
    assert seen.spheres["A"].diameter_mm == pytest.approx(38.1 * (1 + cte * (at_c - 20)), rel=1e-14)
    assert seen.spheres["B"] == spheres["B"]
    again = artefact_when_seen(seen.spheres, seen.lengths, [told])
    assert (again.spheres, again.lengths, again.notes) == (seen.spheres, seen.lengths, ())


@given(lengths_mm, ctes, celsius, st.floats(0.1, 3.0))
def test_the_uncertainty_is_that_of_the_law_of_propagation(length_mm: float, cte: float, at_c: float, sigma_k: float) -> None:
    """Finite differences of the correction itself in temperature and coefficient, 10 % of the latter."""

    def change(t: float, a: float) -> float:
        return growth(length_mm, a, 20.0, Temperature(t, sigma_k, "artefact")).change_mm

    by_temperature = (change(at_c + 0.5, cte) - change(at_c - 0.5, cte)) * sigma_k
    by_coefficient = (change(at_c, 1.05 * cte) - change(at_c, 0.95 * cte)) / 0.1 * 0.1
    found = growth(length_mm, cte, 20.0, Temperature(at_c, sigma_k, "artefact")).standard_uncertainty_mm
    assert found == pytest.approx(np.hypot(by_temperature, by_coefficient), rel=1e-6, abs=1e-12)


def expanded_mm(readings_c: Sequence[Mapping[str, float]]) -> float:
    return artefact_when_seen({"A": ball(), "B": ball()}, [bar()], [session(readings_c)]).lengths[0].expanded_uncertainty_mm


def test_less_is_known_far_from_the_reference_in_the_air_in_drift_and_without_a_sensor() -> None:
    at_reference = expanded_mm([{"artefact": 20.0}])
    assert at_reference == pytest.approx(2 * np.hypot(0.002, 500 * STEEL * 0.5))
    warmer = [expanded_mm([{"artefact": 20.0 + off}]) for off in (2, 5, 10)]
    assert [at_reference, *warmer] == sorted([at_reference, *warmer])
    assert expanded_mm([{"artefact": 15.0}]) == pytest.approx(expanded_mm([{"artefact": 25.0}]))
    assert expanded_mm([{"air": 20.0}]) == pytest.approx(2 * np.hypot(0.002, 500 * STEEL * 1.0))
    # one length stands for shots at 18 and at 22 degrees
    assert expanded_mm([{"artefact": 18.0}, {"artefact": 22.0}]) == pytest.approx(2 * np.hypot(0.002, 500 * STEEL * np.hypot(0.5, 2.0)))
    assert expanded_mm([{}]) == pytest.approx(2 * np.hypot(0.002, 500 * STEEL * 2.0))


def test_an_unknown_temperature_leaves_the_size_and_says_so() -> None:
    seen = artefact_when_seen({"A": ball(), "B": ball()}, [bar(reference_c=23.0)], [session([{"housing": 38.0}])])
    assert seen.lengths[0].length_mm == 500.0
    assert seen.notes == ("lengths taken as at 23 C, 2 K uncertain (1 sigma 11.5 um on 500 mm): no shot tells the artefact's temperature",)


@given(st.lists(st.tuples(lengths_mm, st.floats(-1, 1)), min_size=1, max_size=4), celsius)
def test_no_combination_of_lengths_is_stated_too_well(bars: list[tuple[float, float]], at_c: float) -> None:
    """Thermal errors of lengths in one solve come from one thermometer: they add up, and do not average out."""
    spheres = {name: ball() for name in "ABCDE"}
    lengths = [bar(length, between=("A", "BCDE"[i])) for i, (length, _) in enumerate(bars)]
    told = [session([{"artefact": at_c}], "ABCDE")]
    alone, together = (artefact_when_seen(spheres, lengths, told, used_together=used).lengths for used in (False, True))
    weights = np.array([weight for _, weight in bars])
    common = np.sqrt([(x.expanded_uncertainty_mm / 2) ** 2 - 0.002**2 for x in alone])
    stated = np.array([(x.expanded_uncertainty_mm / 2) ** 2 - 0.002**2 for x in together])
    assert (weights**2 * stated).sum() >= (weights @ common) ** 2 - 1e-15
    assert together[0].expanded_uncertainty_mm == pytest.approx(2 * np.hypot(0.002, common[0] * len(bars) ** 0.5))


def test_the_sensor_on_the_artefact_comes_first_and_a_housing_never() -> None:
    def shots(*readings: Mapping[str, float]) -> Sequence[Shot]:
        return session(readings, "A").shots

    assert artefact_temperature(shots({"artefact": 21.0, "air": 30.0}, {"air": 30.0})) == Temperature(21.0, 0.5, "artefact")
    assert artefact_temperature(shots({"air": 22.0, "room": 24.0, "housing": 40.0})) == Temperature(23.0, 1.0, "air")
    assert artefact_temperature(shots({"housing": 40.0}, {})) is None
    assert artefact_temperature(()) is None
    found = artefact_temperature(shots(*({"artefact": t} for t in (21.0, 21.0, 21.0, 21.0, 60.0))))
    assert found is not None
    assert found.celsius == 21.0  # one wild reading moves nothing, but is not hidden
    assert found.standard_uncertainty_k > 10


def test_sizes_that_no_shot_shows_are_left_alone() -> None:
    lengths = (bar(),)
    spheres = {"A": ball(STEEL), "B": ball(STEEL)}
    only_a = artefact_when_seen(spheres, lengths, [session([{"artefact": 30.0}], "A")])
    assert only_a.lengths == lengths
    assert only_a.spheres["B"] == spheres["B"]
    assert only_a.notes == ("diameters corrected to 30.0 C of the artefact (+4.4 um on 38 mm)",)
    failed = artefact_when_seen(spheres, lengths, [session([{"artefact": 30.0}], status="failed")])
    assert (failed.spheres, failed.lengths, failed.notes) == (spheres, lengths, ())


def test_another_temperature_than_the_calibrations_is_told() -> None:
    seen = temperature_ranges_c([session([{"air": 20.0, "housing": 33.0}, {"air": 22.5}])])
    assert seen == {"air": (20.0, 22.5), "housing": (33.0, 33.0)}
    assert temperature_changes(seen, [session([{"air": 27.4, "housing": 28.1, "elbow": 60.0}])]) == ()
    warmer = temperature_changes(seen, [session([{"air": 27.6}, {"air": 27.6}, {"air": 0.0}])])
    assert warmer == ("temperature air: 27.6 C, and the calibration saw 20.0 to 22.5 C; arm and camera may have changed",)
    assert len(temperature_changes(seen, [session([{"air": 14.9}])])) == 1
    assert temperature_changes({}, [session([{"air": 14.9}])]) == ()


def shots_of_bar(n_shots: int, seed: int) -> dict[str, list[SyntheticShot]]:
    rng = np.random.default_rng(seed)
    return {name: noise_free(replace(paper_cell(), centre_in_base_mm=np.array(place)), rng, n_shots, n_points=150) for name, place in PLACES.items()}


def bar_session(folder: Path, shots: Mapping[str, Sequence[SyntheticShot]], readings_c: Sequence[Mapping[str, float]], cte: float | None) -> Session:
    """A steel bar that is 500 mm long at 25 degrees, certified at 20."""
    length = {"between": ["A", "B"], "length_mm": 500.0 / (1 + STEEL * 5.0), "expanded_uncertainty_mm": 0.001}
    length |= {} if cte is None else {"cte_per_k": cte}
    cell = paper_cell()
    extra = {"lengths": [length], "limits": {"centre_rms_mm": 0.2, "length_error_mm": 0.02, "diameter_error_mm": 0.2, "form_mm": 0.5}}
    return read_session(warm(write_session(folder, cell, shots, flange_from_camera=cell.flange_from_camera, extra_cell=extra), readings_c))


@pytest.fixture(scope="module")
def calibrations(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Calibration]:
    """Of one bar at 25 degrees, with its coefficient and without."""
    folder, shots = tmp_path_factory.mktemp("bar"), shots_of_bar(25, 1)
    found = {}
    for name, cte in (("corrected", STEEL), ("as certified", None)):
        read = bar_session(folder / name, shots, [{"artefact": 25.0, "housing": 34.0}], cte)
        found[name] = calibrate([read], CalibrationSettings(camera_error="pillow"))
    return found


def scale_error(calibration: Calibration) -> float:
    a, b = (calibration.sphere_centres_in_base_mm[name] for name in "AB")
    return float(np.linalg.norm(a - b)) / 500.0 - 1


def test_a_warm_bar_gives_the_right_scale_only_with_its_correction(calibrations: Mapping[str, Calibration]) -> None:
    assert abs(scale_error(calibrations["corrected"])) < 0.15 * STEEL * 5
    assert scale_error(calibrations["as certified"]) == pytest.approx(-STEEL * 5, rel=0.3)
    assert "lengths corrected to 25.0 C of the artefact (+28.7 um on 500 mm)" in calibrations["corrected"].reasons
    assert not any("corrected to" in reason for reason in calibrations["as certified"].reasons)


def test_a_method_that_uses_no_length_corrects_none(tmp_path: Path) -> None:
    session = bar_session(tmp_path / "s", shots_of_bar(20, 3), [{"artefact": 25.0}], STEEL)
    found = calibrate([session], CalibrationSettings(method="stepwise", camera_error="none"))
    assert not any("lengths corrected" in reason for reason in found.reasons), found.reasons


def test_the_file_holds_the_temperatures_seen(calibrations: Mapping[str, Calibration], tmp_path: Path) -> None:
    calibrations["corrected"].save(tmp_path / "c.yaml")
    assert Calibration.load(tmp_path / "c.yaml").temperatures_c == {"artefact": (25.0, 25.0), "housing": (34.0, 34.0)}


def test_verification_takes_the_length_at_its_own_temperature(tmp_path: Path) -> None:
    system = replace(TrueSystem(paper_cell()), temperatures_c={"artefact": (18.0, 19.5)})
    shots = shots_of_bar(5, 2)
    found = {}
    for name, readings, cte in (("warm", [{"artefact": 25.0}], STEEL), ("plain", [{"artefact": 25.0}], None), ("unknown", [{}], STEEL)):
        found[name] = verify(system, [bar_session(tmp_path / name, shots, readings, cte)])
    certified = 500.0 / (1 + STEEL * 5.0)
    assert {name: result.lengths[0].reference_mm for name, result in found.items()} == pytest.approx(
        {"warm": 500.0, "plain": certified, "unknown": certified}, abs=1e-9
    )
    assert abs(found["warm"].lengths[0].error_mm) < 0.01 < abs(found["plain"].lengths[0].error_mm)
    test = {name: result.lengths[0].test_standard_uncertainty_mm for name, result in found.items()}
    assert test["plain"] < test["warm"] < test["unknown"]
    assert any("corrected to 25.0 C" in reason for reason in found["warm"].reasons)
    assert any("no shot tells the artefact's temperature" in reason for reason in found["unknown"].reasons)
    assert any("the calibration saw 18.0 to 19.5 C" in reason for reason in found["plain"].reasons)


@given(st.lists(st.dictionaries(st.sampled_from(["artefact", "air", "x"]), st.floats(-100, 310)), min_size=1, max_size=4))
def test_odd_readings_are_told_or_taken(readings: list[dict[str, float]]) -> None:
    told, spheres = [session(readings)], {"A": ball(STEEL), "B": ball()}
    asked = [r["artefact"] for r in readings if "artefact" in r] or [r["air"] for r in readings if "air" in r]
    if not all(-50 < celsius < 100 for celsius in asked):
        with pytest.raises(DataError, match="degrees Celsius"):
            artefact_when_seen(spheres, [bar()], told)
        return
    seen = artefact_when_seen(spheres, [bar()], told)
    assert 490 < seen.lengths[0].length_mm < 510
    assert seen.lengths[0].expanded_uncertainty_mm > 0.004
    assert all("\n" not in note for note in (*seen.notes, *temperature_changes(temperature_ranges_c(told), told)))
