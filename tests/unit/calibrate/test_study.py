"""The study: complete, repeatable, and its findings are in its own figures."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.study import Study, run_study
from calibrate.study_data import Cell, StudyTable, medians, spread_of
from calibrate.study_methods import LABELS
from calibrate.study_paper import TABLE_3, TABLE_5
from tests.support.study import TINY, tiny_study

METHODS = ("1", "2", "3", "4")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return tiny_study(tmp_path_factory)


def number(cell: Cell) -> float:
    assert isinstance(cell, float | int)
    return float(cell)


def test_every_table_and_figure_of_the_paper_is_there(study: Study) -> None:
    tables = {"comparison", "table3", "table5", "stitching", "figure7", "figure8", "gauge", "order", "guess_signs", "table3_clouds"}
    printed = {f"printed_figure{number}" for number in (5, 6, 7, 8, 10, 11)}
    assert {table.name for table in study.tables} == tables | printed
    figures = {"figure5", "figure6", "figure7", "figure8", "figure10", "figure11", "figure13", "figure14", "descent"}
    assert {figure.name for figure in study.figures} == figures
    for table in study.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)
    for figure in study.figures:
        for curve in (curve for panel in figure.panels for curve in panel.curves):
            assert len(curve.x) == len(curve.y)
            assert np.isfinite(curve.y).all()


def test_printed_figures_stand_beside_ours(study: Study) -> None:
    printed = {str(row[0]): row[1] for row in study.table("comparison").rows}
    for method in METHODS:
        assert printed[f"Table 3, method {method}, e_mean"] == TABLE_3[method][0] == study.table("table3").row(LABELS[method])["paper_e_mean_mm"]
        assert printed[f"Table 5, method {method}, max"] == TABLE_5[method][1]
    assert all(row[3] in {"no", "in size"} and row[4] for row in study.table("comparison").rows)
    assert not any("Table 2" in str(row[0]) for row in study.table("comparison").rows)


def test_what_the_paper_prints_about_its_plots_stands_beside_ours(study: Study) -> None:
    """Printed figures as in the paper; ours are those of the curves."""
    rows = {str(row[0]): row for n in (5, 6, 7, 8, 10, 11) for row in study.table(f"printed_figure{n}").rows}
    assert all(row[3] in {"yes", "in size", "no"} and row[4] for row in rows.values())
    added = rows["camera error added, largest, mm (6d; section 4.1)"]
    camera = next(panel for panel in study.figure("figure6").panels if panel.title == "camera")
    assert (added[1], added[2]) == (1.6, max(camera.curves[1].y))
    before = rows["hand-eye error before, mm (6c; printed matrices)"]
    assert number(before[1]) == pytest.approx(1.865, abs=1e-3)
    assert number(before[2]) == pytest.approx(number(before[1]), abs=1e-9)
    found = rows["hand-eye error left by method 1, mm (6c; printed matrices)"]
    assert number(found[1]) == pytest.approx(0.218, abs=1e-3)
    # Table 2's k leave next to nothing of the simulated error, which is what makes the lost exponents' signs right
    assert number(rows["camera error left by method 1, largest, mm (6d; k of Table 2 at our places)"][1]) < 0.05
    assert str(rows["with growing z (section 2.2)"][2]).startswith("decreases, by")


def test_methods_rank_as_in_the_paper_by_spread(study: Study) -> None:
    rms = {m: number(study.table("table3").row(LABELS[m])["rms_about_mean_mm"]) for m in ("1", "2", "3")}
    assert rms["1"] < rms["2"] < rms["3"]


def test_the_slide_of_other_poses_sees_what_the_slide_of_the_same_poses_hides(study: Study) -> None:
    table = study.table("table5")
    first = {m: table.row(f"{LABELS[m]}, free radius") for m in METHODS}
    assert number(first["3"]["d_mean_mm"]) > 5 * number(first["2"]["d_mean_mm"])
    blind = [number(first[m]["same_poses_d_mean_mm"]) for m in ("2", "3", "4")]
    assert np.ptp(blind) < 0.03 * blind[0] + 2e-3


def test_whole_clouds_are_best_on_clouds(study: Study) -> None:
    table = study.table("table3_clouds")
    column = table.columns.index("rms_about_mean_mm")
    values = [number(row[column]) for row in table.rows]
    assert values[-1] == min(values)
    assert table.rows[-1][0] == LABELS["clouds"]


def test_e_mean_moves_with_the_rank_tolerance_and_the_spread_does_not(study: Study) -> None:
    table = study.table("gauge")
    e_mean = [number(cell) for cell in table.column("method1_e_mean_mm")]
    rms = [number(cell) for cell in table.column("method1_rms_about_mean_mm")]
    assert np.ptp(e_mean) > 10 * np.ptp(rms)


def test_order_moves_the_stepwise_result_alone(study: Study) -> None:
    table = study.table("order")
    assert max(number(cell) for cell in table.column("stepwise_moved_by_mm")) > 0.005
    assert max(number(cell) for cell in table.column("joint_moved_by_mm")) < 1e-3


def test_a_bent_sphere_reads_wrong_and_corrected_points_read_right(study: Study) -> None:
    along_z = study.figure("figure11").panels[2]
    worst = {curve.label: float(np.abs(curve.y - 38.1).max()) for curve in along_z.curves}
    assert worst["as measured"] > 0.1
    assert worst[f"corrected, {LABELS['clouds']}"] < 0.3 * worst["as measured"]
    fig_5 = {curve.label: curve.y for curve in study.figure("figure5").panels[2].curves}
    assert (fig_5["k of the other sign"] > 38.1).all()
    assert (np.diff(fig_5["k of the other sign"]) < 0).all()


def test_the_same_seed_gives_the_same_figures_and_progress_ends_at_its_total(study: Study) -> None:
    told: list[tuple[int, int]] = []
    again = run_study(TINY, progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))
    for table in study.tables:
        other = again.table(table.name)
        keep = [i for i, name in enumerate(table.columns) if name != "seconds"]
        assert [[row[i] for i in keep] for row in table.rows] == [[row[i] for i in keep] for row in other.rows]


def test_spread_is_what_it_says() -> None:
    centres = np.array([[1.0, 0, 0], [3.0, 0, 0]])
    spread = spread_of(centres, np.zeros(3))
    assert (spread.e_mean_mm, spread.e_max_mm, spread.std_mm, spread.rms_about_mean_mm) == (2.0, 3.0, 1.0, 1.0)


def test_medians_go_cell_by_cell() -> None:
    assert medians([("a", 1.0, None, 5), ("a", 3.0, None, 1), ("a", 2.0, None, 9)]) == ("a", 2.0, None, 5.0)
    table = StudyTable("t", ("name", "x"), (("a", 1.0), ("b", 2.0)))
    assert table.row("b") == {"name": "b", "x": 2.0}
    assert table.column("x") == [1.0, 2.0]
