"""The paper's printed figures beside ours, and whether the two can be held against each other at all."""

from __future__ import annotations

from calibrate.study_data import Cell, StudyTable
from calibrate.study_methods import LABELS

DATUM = "a datum: consecutive differences do not fix the base frame, so the figure follows the rank tolerance (table gauge)"
POSES = "same order of size at most: the paper gives neither its poses nor the minus signs of its first guess"
GAUGE = "a datum again: 140 mm off and yet 0.7 mm apart is a base frame that drifted along directions the data leave open"
HARDWARE = "hardware against simulation: same protocol, other camera errors and other poses"
CONTRADICTED = "the paper's sentence gives method 4 a figure and says that it has none"


def comparison(table_3: StudyTable, table_5: StudyTable, stitching: StudyTable) -> StudyTable:
    """Every printed figure, ours, whether they can agree, and why (not)."""
    rows: list[tuple[Cell, ...]] = []
    for method in ("1", "2", "3", "4"):
        row = table_3.row(LABELS[method])
        rows += [
            (f"Table 3, method {method}, e_mean", row["paper_e_mean_mm"], row["e_mean_mm"], "no", GAUGE if method == "4" else DATUM),
            (f"Table 3, method {method}, std", row["paper_std_mm"], row["std_mm"], "in size", POSES),
        ]
    for method in ("1", "2", "3", "4"):
        row = table_5.row(f"{LABELS[method]}, free radius")
        for figure in ("mean", "max", "std"):
            rows.append((f"Table 5, method {method}, {figure}", row[f"paper_d_{figure}_mm"], row[f"d_{figure}_mm"], "in size", HARDWARE))
    for method in ("1", "2", "4"):
        row = stitching.row(f"{LABELS[method]}, free radius")
        verdict = ("no", CONTRADICTED) if method == "4" else ("in size", HARDWARE)
        rows.append((f"Stitched diameter error, method {method}", row["paper_diameter_error_mm"], row["diameter_error_12_mm"], *verdict))
    return StudyTable("comparison", ("figure", "printed_mm", "ours_mm", "comparable", "why"), tuple(rows))
