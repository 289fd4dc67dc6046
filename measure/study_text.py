"""The words of study.html: what each table and figure of the paper is, where ours can agree with it and where not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the page."""

    title: str
    lead: str
    agree: str = ""
    """Where ours and the paper's can agree, and do or do not."""
    differ: str = ""
    """Where they cannot, and why."""
    tables: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()


SECTIONS = (
    Section(
        "Printed and computed, side by side",
        "Every figure that the paper prints for its methods 1 to 4, and the same figure from this run. What it prints about its plots "
        "stands with each of them below; nothing was read off a plot.",
        tables=("comparison",),
    ),
    Section(
        "The simulation",
        "IRB 1410 of Table 1 with its bracketed errors, camera error k = (1e-9, 7e-15, 5e-18) on z about (60, 0, 500), noise on the elements of "
        "base_from_flange (1e-4, 0.01 mm) and on the sphere centre (0.01 mm), 100 training and 100 test poses. The paper does not tell its poses; "
        "ours: sphere at (900, 100, 300), 250 to 400 mm from the camera, up to 22 and 13 degrees off its axis, camera tilted up to 40 degrees from "
        "straight down, any roll, any branch of the arm. The printed first guess of the hand-eye transform lost its minus signs: the table shows "
        "what the choice does to the uncalibrated method 3. The first row is used here.",
        differ="Method 3 depends on nothing but poses and signs, so its printed figures cannot be met but by luck.",
        tables=("guess_signs",),
    ),
    Section(
        "Table 3: methods 1 to 4 on simulated sphere centres",
        "Medians over the draws. e_mean, e_max and std are the paper's: mean, maximum and standard deviation of the distance from the true "
        "place, on noise-free tests. Rms about the mean is what a calibration is good for; lengths are between places that no training sphere "
        "stood at.",
        agree="Order and size of the spread: method 1 far below method 2, method 2 far below method 3.",
        differ="e_mean and e_max are mostly a shift of the whole base frame, which differences of positions cannot see. So method 2 can have a "
        "larger e_mean than no calibration at all, as in the paper, with a small part of its spread. Method 4 does not fail: with its gauge left to "
        "noise it lands elsewhere, up to tens of millimetres away, with the spread unchanged, and that is what 134.8 mm with a std of 0.66 "
        "looks like.",
        tables=("table3",),
    ),
    Section(
        "What e_mean depends on",
        "The same shots, solved with different rank tolerances of the least-squares steps: e_mean moves, the spread does not.",
        tables=("gauge",),
    ),
    Section(
        "Table 2: not compared",
        "The printed twists reach 0.50 rad. Applied to the robot they spread one sphere over 137 to 300 mm, so the table cannot be what was "
        "computed; 18 of the 42 geometric parameters are gauge in any case, and single twists or k's mean nothing.",
    ),
    Section(
        "Fig 6: what is left of each error",
        "Position error of the flange, of the hand-eye transform, and of the camera's point at every noise-free test.",
        agree="The camera error is removed by method 1 to a small part of what it was.",
        differ="The last link's twist and the hand-eye twist are one and the same displacement, and the base frame is free: what one part gives away "
        "another takes, and the block that comes first takes all. No data of this kind can say that the hand-eye transform alone was found, or "
        "the robot alone; only their sum is real.",
        tables=("printed_figure6",),
        figures=("figure6",),
    ),
    Section(
        "Fig 7: noise",
        "The paper's noise times a level, camera error zero.",
        agree="The spread of methods 1 and 2 stays far below that of method 3 and rises with the noise.",
        differ="Method 4's sensitivity to noise is its gauge: e_mean of the variant that leaves it open runs away, its spread is that of method 2.",
        tables=("printed_figure7", "figure7"),
        figures=("figure7",),
    ),
    Section(
        "Fig 8: camera error",
        "The paper's k times a factor, no noise; the axis is the mean camera error at the sphere.",
        agree="A camera error that is left out (methods 2 and 4) spoils the calibration in proportion; method 1 takes it out.",
        differ="Where the lines of e_mean cross is a matter of the datum. The spread of methods 2 and 4 stays below that of method 3 throughout.",
        tables=("printed_figure8", "figure8"),
        figures=("figure8",),
    ),
    Section(
        "The solver itself",
        "Algorithm 1 moves one block after the other; all blocks at once (Gauss-Newton on the same centres) need a handful of steps. "
        "Consecutive differences make the result depend on the order of the shots, which it must not.",
        differ="Found here, not in the paper: taken in another order the same shots give another stepwise calibration, the move being as large as "
        "its error; the joint solve moves by rounding.",
        tables=("order",),
        figures=("descent",),
    ),
    Section(
        "Figs 5 and 11: fitted diameter over the camera's volume",
        "A sphere of 38.1 mm fitted with a free radius, before and after the correction that each calibration found.",
        agree="A depth error bends the sphere, most where the camera is near; corrected points read close to the certified diameter.",
        differ="The paper's camera always reads large, by up to 0.4 mm, less so far away. With the simulated k a sphere reads small; with the other "
        "sign, which is that of the k found on hardware (Table 4), it reads large and falls with z, as in the paper's Fig 5. Method 1 fits k to "
        "centres of free-radius fits, which move with the bend, and overshoots: the paper too finds its deviation not completely eliminated.",
        tables=("printed_figure5", "printed_figure11"),
        figures=("figure5", "figure11"),
    ),
    Section(
        "Fig 10: size of each compensation",
        "How far robot, hand-eye and camera are moved at each noisy test.",
        differ="How a displacement is split between robot and hand-eye is decided by the gauge and by the order of the blocks; the paper itself "
        "calls the values a reference only.",
        tables=("printed_figure10",),
        figures=("figure10",),
    ),
    Section(
        "Table 5: a sphere on a 50 mm slide",
        "25 pairs of shots, other poses at each end, slide good to 0.03 mm; a simulated twin of the hardware test, spheres seen as clouds with "
        "0.08 mm depth noise. The last columns repeat the poses of the first end at the second.",
        agree="The protocol gives figures of the paper's size for all four methods, uncalibrated ones included.",
        differ="Hardware has errors that the twin has not. With the same poses at both ends methods 2, 3 and 4 read alike: such a test is blind to "
        "robot and hand-eye error, and `verify` refuses it.",
        tables=("table5",),
    ),
    Section(
        "Figs 12 to 14: stitched clouds",
        "Three, then twelve clouds of a sphere at another place, stitched in the base. Pictures: deviation from the best certified sphere in a slice "
        "through its middle, one colour a shot.",
        agree="Uncalibrated, the clouds lie millimetres apart; method 1 closes them best of the paper's four.",
        differ="The fitted diameter of a stitched sphere flatters: errors of opposite shots cancel in it. The radial rms does not.",
        tables=("stitching",),
        figures=("figure13", "figure14"),
    ),
    Section(
        "What is gained by solving on points",
        "The same shots once more, the spheres as clouds: the paper's methods on fitted centres, all at once on fixed-radius centres, and the "
        "whole-cloud solve that `spherecal calibrate` uses.",
        differ="The paper corrects fitted centres. A depth error also bends the cloud, and the free radius moves the centre with it; correcting the "
        "points takes both out.",
        tables=("table3_clouds",),
    ),
)

HEADS: Mapping[str, str] = MappingProxyType(
    {
        "printed": "paper prints",
        "ours": "here",
        "printed_mm": "paper, mm",
        "ours_mm": "here, mm",
        "comparable": "can agree",
        "paper_e_mean_mm": "paper e_mean",
        "paper_e_max_mm": "paper e_max",
        "paper_std_mm": "paper std",
        "rms_about_mean_mm": "rms about mean",
        "rms_about_mean_noisy_mm": "the same, noisy tests",
        "paper_d_mean_mm": "paper mean",
        "paper_d_max_mm": "paper max",
        "paper_d_std_mm": "paper std",
        "d_mean_mm": "mean",
        "d_max_mm": "max",
        "d_std_mm": "std",
        "paper_diameter_error_mm": "paper diameter error",
        "diameter_error_3_mm": "diameter error, 3 clouds",
        "radial_rms_3_mm": "radial rms, 3 clouds",
        "diameter_error_12_mm": "diameter error, 12 clouds",
        "radial_rms_12_mm": "radial rms, 12 clouds",
    }
)
"""Table heads where the column's own name does not read well; lengths are in mm unless a head says otherwise."""


def head_of(column: str) -> str:
    """How a column is headed on the page."""
    return HEADS.get(column, column.removesuffix("_mm").replace("_", " "))
