"""Studies of a gauge: published figures, laws, files that come back, and tables that are no tables."""

from __future__ import annotations

import json
import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from drivers.errors import DataError, FileError
from measure.cli import app
from measure.cli_run import run_app
from measure.gauge.approach import drifts, reversals
from measure.gauge.correlation import Correlation, correlate, load_correlation, save_correlation
from measure.gauge.dfq import dfq_text
from measure.gauge.repeatability import RepeatSettings, repeatability
from measure.gauge.reproducibility import reproducibility
from measure.gauge.table import Measured, parse_table_of_values, read_table, write_table

# the example of the AIAG manual Measurement Systems Analysis (4th edition, gauge R&R): parts x trials for each appraiser
AIAG = {
    "A": "0.29 0.41 0.64 -0.56 -0.68 -0.58 1.34 1.17 1.27 0.47 0.50 0.64 -0.80 -0.92 -0.84 "
    "0.02 -0.11 -0.21 0.59 0.75 0.66 -0.31 -0.20 -0.17 2.26 1.99 2.01 -1.36 -1.25 -1.31",
    "B": "0.08 0.25 0.07 -0.47 -1.22 -0.68 1.19 0.94 1.34 0.01 1.03 0.20 -0.56 -1.20 -1.28 "
    "-0.20 0.22 0.06 0.47 0.55 0.83 -0.63 0.08 -0.34 1.80 2.12 2.19 -1.68 -1.62 -1.50",
    "C": "0.04 -0.11 -0.15 -1.38 -1.13 -0.96 0.88 1.09 0.67 0.14 0.20 0.11 -1.46 -1.07 -1.45 "
    "-0.29 -0.67 -0.49 0.02 0.01 0.21 -0.46 -0.56 -0.49 1.77 1.45 1.87 -1.49 -1.77 -2.16",
}


def aiag() -> list[Measured]:
    return [
        Measured("bore", float(value), part=f"{i // 3 + 1:02d}", operator=operator, trial=str(i % 3))
        for operator, values in AIAG.items()
        for i, value in enumerate(values.split())
    ]


def test_the_published_study_comes_out() -> None:
    """AIAG's own results by analysis of variance: EV 0.200, AV 0.227, no interaction, GRR 0.302, PV 1.042, ndc 4."""
    (found,) = reproducibility(aiag())
    assert found.pooled
    assert found.repeatability_mm == pytest.approx(0.199933, abs=1e-6)
    assert found.reproducibility_mm == pytest.approx(0.226838, abs=1e-6)
    assert found.gauge_mm == pytest.approx(0.302373, abs=2e-6)
    assert found.parts_mm == pytest.approx(1.042327, abs=1e-6)
    assert found.share_of_variation == pytest.approx(0.2786, abs=1e-4)
    assert found.n_categories == 4


def test_the_order_of_rows_changes_nothing_and_a_gap_is_told() -> None:
    rows = aiag()
    shuffled = [rows[i] for i in np.random.default_rng(1).permutation(len(rows))]
    assert reproducibility(shuffled)[0].gauge_mm == pytest.approx(reproducibility(rows)[0].gauge_mm, rel=1e-12)
    with pytest.raises(DataError, match="part 01, operator A"):
        reproducibility(rows[1:])


def test_variances_are_found_that_made_the_values() -> None:
    """Mean over drawn studies: no share is taken for another."""
    rng, found = np.random.default_rng(2), []
    for _ in range(60):
        part, operator, both = rng.normal(0, 0.5, 10), rng.normal(0, 0.1, 3), rng.normal(0, 0.08, (10, 3))
        rows = [
            Measured("f", part[p] + operator[o] + both[p, o] + rng.normal(0, 0.05), part=f"{p:02d}", operator=str(o))
            for p in range(10)
            for o in range(3)
            for _ in range(3)
        ]
        found.append(reproducibility(rows)[0])
    assert np.mean([one.repeatability_mm**2 for one in found]) == pytest.approx(0.05**2, rel=0.1)
    assert np.mean([one.interaction_mm**2 for one in found]) == pytest.approx(0.08**2, rel=0.2)
    assert np.mean([one.operators_mm**2 for one in found]) == pytest.approx(0.1**2, rel=0.5)
    assert np.mean([one.parts_mm**2 for one in found]) == pytest.approx(0.5**2, rel=0.2)


def repeats(values: list[float], **more: float) -> list[Measured]:
    return [Measured("length", value, **more) for value in values]  # type: ignore[arg-type]


def test_cg_and_cgk_by_their_definition_and_bias_by_chance() -> None:
    values = list(10.0 + 0.01 * stats.norm.ppf(np.linspace(0.02, 0.98, 30)) + 0.004)
    s = float(np.std(values, ddof=1))
    (one,) = repeatability(repeats(values, lower_mm=9.8, upper_mm=10.2, reference_mm=10.0))
    assert one.cg == pytest.approx(0.2 * 0.4 / (6 * s))
    assert one.cgk == pytest.approx((0.1 * 0.4 - 0.004) / (3 * s))
    assert one.bias_is_significant
    assert one.standard_deviation_interval_mm[0] < s < one.standard_deviation_interval_mm[1]
    (other,) = repeatability(repeats(values, lower_mm=9.8, upper_mm=10.2), RepeatSettings(spread=4.0))
    assert other.cg == pytest.approx(0.2 * 0.4 / (4 * s))
    assert other.cgk is None
    # the smallest tolerance is the one at which it just passes
    half = other.least_tolerance_mm / 2
    (just,) = repeatability(repeats(values, lower_mm=10 - half, upper_mm=10 + half), RepeatSettings(spread=4.0))
    assert just.cg == pytest.approx(1.33)


def test_without_tolerance_nothing_is_judged_and_few_repeats_are_refused() -> None:
    assert repeatability(repeats([1.0 + 0.01 * i for i in range(12)]))[0].capable is None
    with pytest.raises(DataError, match="9 repeats are too few"):
        repeatability(repeats([1.0] * 9))


def test_a_reversal_is_found_with_its_sign_and_chance_is_not_one() -> None:
    rng = np.random.default_rng(3)
    covered = []
    for shift in (0.03, 0.0):
        for _ in range(100):
            rows = [Measured("f", rng.normal(5.0 + shift * side, 0.01), direction="-+"[side]) for side in (0, 1) for _ in range(8)]
            (found,) = reversals(rows)
            assert found.directions == ("+", "-")
            covered.append(abs(found.difference_mm + shift) <= found.expanded_uncertainty_mm)
    assert 0.88 <= np.mean(covered) <= 0.99


def test_a_warm_up_is_told_from_a_straight_drift() -> None:
    minutes, rng = np.linspace(0, 120, 41), np.random.default_rng(4)
    warm = [Measured("f", 7.0 - 0.08 * np.exp(-t / 25) + rng.normal(0, 0.002), minutes=float(t)) for t in minutes]
    straight = [Measured("f", 7.0 + 0.06 * t / 60 + rng.normal(0, 0.002), minutes=float(t)) for t in minutes]
    (found,) = drifts(warm)
    assert found.time_constant_minutes == pytest.approx(25, rel=0.15)
    assert found.warm_mm == pytest.approx(7.0, abs=0.002)
    assert found.settled_after_minutes(0.01) == pytest.approx(25 * np.log(8), rel=0.15)
    (line,) = drifts(straight)
    assert line.time_constant_minutes is None
    assert line.settled_after_minutes(0.01) is None
    assert abs(line.slope_mm_per_hour - 0.06) < 2 * line.slope_expanded_uncertainty_mm_per_hour
    assert line.span_mm == pytest.approx(0.12, abs=0.005)


def test_offsets_cover_what_is_between_the_gauges_and_slopes_are_told(tmp_path: Path) -> None:
    rng, covered, honest = np.random.default_rng(5), [], []
    for _ in range(200):
        parts = rng.normal(10, 0.2, 6)
        rows = [Measured("f", value + rng.normal(0, 0.01), part=str(i), reference_mm=float(value + 0.05)) for i, value in enumerate(parts)]
        found = correlate(rows)["f"]
        covered.append(abs(found.offset_mm - 0.05) <= found.expanded_uncertainty_mm)
        honest.append(found.slope_is_one)
    assert 0.88 <= np.mean(covered) <= 0.99
    assert np.mean(honest) > 0.85
    steep = [Measured("f", float(v), part=str(i), reference_mm=1.5 * float(v) + rng.normal(0, 1e-3)) for i, v in enumerate(rng.normal(10, 0.2, 8))]
    assert not correlate(steep)["f"].slope_is_one
    first = save_correlation(Correlation(correlate(rows)), tmp_path / "c.yaml")
    again = save_correlation(Correlation(correlate(steep), note="CMM"), tmp_path / "c.yaml")
    assert (first.version, again.version) == (1, 2)
    assert load_correlation(tmp_path / "c.yaml") == again
    text = (tmp_path / "c.yaml").read_text(encoding="utf-8")
    (tmp_path / "c.yaml").write_text(text.replace("offset_mm: ", "offset_mm: 1", 1), encoding="utf-8")
    with pytest.raises(FileError, match="changed by hand"):
        load_correlation(tmp_path / "c.yaml")


def test_a_table_comes_back(tmp_path: Path) -> None:
    rows = [Measured("a, b", 1.25, 1.0, 0.5, 1.5, "p", "o", "1", "+", 3.0, 1.2, "2026-11-22T09:30:00Z"), Measured("c", -2.0)]
    write_table(rows, tmp_path / "t.csv")
    assert read_table(tmp_path / "t.csv") == rows


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no values"),
        ("feature,value_mm\n", "holds no values"),
        ("feature,value\na,1", "not understood"),
        ("feature,value_mm,value_mm\na,1,2", "not understood"),
        ("feature,value_mm\na,one", "value_mm: 'one' is no finite number"),
        ("feature,value_mm\na,nan", "no finite number"),
        ("feature,value_mm\na,1,2", "3 values where the header has 2"),
        ("feature,value_mm\n,1", "needs a feature"),
        ("feature,value_mm,lower_mm,upper_mm\na,1,2,1", "lower_mm is not below"),
        ("feature,value_mm,time_utc\na,1,yesterday", "is no time"),
    ],
)
def test_what_is_no_table_is_told(text: str, said: str) -> None:
    with pytest.raises(FileError, match=said) as error:
        parse_table_of_values(text, file="t.csv")
    assert error.value.remedy


@settings(max_examples=100)
@given(st.text(alphabet='feature,value_mm\n"1.5 ', max_size=60))
def test_any_text_is_a_table_or_an_error_of_ours(text: str) -> None:
    try:
        assert parse_table_of_values("feature,value_mm\n" + text, file="t.csv")
    except FileError:
        return


def test_a_transfer_file_holds_every_value_at_its_characteristic() -> None:
    time = "2026-11-22T10:30:00+01:00"
    rows = [Measured("bore", 10.01 + i / 100, 10, 9.9, 10.1, part=str(i), time_utc=time) for i in range(3)]
    rows += [Measured("step\r\nK0001/1 9", 4.0, part="2", time_utc=time)]
    text = dfq_text(rows, part_number="P 7", gauge="cell 3")
    lines = text.split("\r\n")
    fields = dict(line.split(" ", 1) for line in lines if line.startswith("K"))
    assert fields["K0100"] == "2"
    assert fields["K1001"] == "P 7"
    assert (fields["K2101/1"], fields["K2110/1"], fields["K2111/1"]) == ("10.0000", "9.9000", "10.1000")
    assert fields["K2002/2"] == "step K0001/1 9"
    values = [[cell.split("\x14") for cell in line.split("\x0f")] for line in lines if line and not line.startswith("K")]
    assert [float(line[0][0]) for line in values] == [10.01, 10.02, 10.03]
    assert [line[1][1] for line in values] == ["256", "256", "0"]
    assert datetime.strptime(values[0][0][2], "%d.%m.%Y/%H:%M:%S") == datetime(2026, 11, 22, 9, 30)
    with pytest.raises(DataError, match="twice"):
        dfq_text([*rows, rows[0]], part_number="P")


def run(*arguments: str) -> int:
    return run_app(app, ["gauge", *arguments])


def test_from_results_to_a_page_and_a_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, table = np.random.default_rng(6), tmp_path / "values.csv"
    for i in range(12):
        length = {"between": ["A", "B"], "measured_mm": float(rng.normal(500, 0.02)), "reference_mm": 500.0}
        check = {"name": "bore <1>", "unit": "mm", "measured": float(rng.normal(10, 0.01)), "nominal": 10, "lower": 9.5, "upper": 10.5}
        (tmp_path / f"{i}.json").write_text(json.dumps({"lengths": [length], "checks": [check]}), encoding="utf-8")
        assert run("collect", str(tmp_path / f"{i}.json"), "-o", str(table), "--part", "7", "--operator", "o", "-q") == 0
    assert len(read_table(table)) == 24
    capsys.readouterr()
    assert run("repeatability", str(table), "--page", str(tmp_path / "p.html"), "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["feature"] for one in told["features"]] == ["length A-B", "bore <1>"]
    assert told["features"][0]["bias_mm"] == pytest.approx(0, abs=0.02)
    assert told["capable"] is True
    page = (tmp_path / "p.html").read_text(encoding="utf-8")
    assert "bore &lt;1&gt;" in page
    assert not re.search(r"(?:src|href)=\"(?!#|data:)", page)
    assert run("repeatability", str(table), "--limit", "9", "-q") == 3
    assert run("dfq", str(table), "-o", str(tmp_path / "v.dfq"), "--part-number", "7", "-q") == 0
    assert run("rr", str(table), "-q") == 1
