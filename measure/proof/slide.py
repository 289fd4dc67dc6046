"""The paper's slide test: a sphere moved by a known way between two sets of shots (Table 5), as rows for people.

The sphere on its slide is two spheres (`A0`, `A50`) with a certified length between them. Every view of one end is
paired with a view of the other that was taken from another robot pose: from one and the same pose an error of robot and
hand-eye drops out, and such a slide is refused (its length is not judged and `conform` cannot follow).
"""

from __future__ import annotations

from collections.abc import Sequence

from calibrate.study_paper import TABLE_5
from measure.proof.lengths import LengthResult

NOTHING = "–"
_PAPER_MEAN_MM, _PAPER_MAX_MM, _PAPER_STD_MM = TABLE_5["1"]
PAPER_TEXT = f"the paper's method 1 prints {_PAPER_MEAN_MM:.4f} mean, {_PAPER_MAX_MM:.4f} max, {_PAPER_STD_MM:.4f} std over 25 pairs on hardware"
CAUTION = (
    f"For comparison, {PAPER_TEXT}. Figures may differ with the repeatability of robot and camera, the slide's own error (0.03 mm there), the poses, "
    "which the paper does not tell, and the sphere fit. A way of 50 mm sees little: scale and a bent base show on lengths across the work volume."
)


def slide_rows(slides: Sequence[LengthResult]) -> list[tuple[str, ...]]:
    """One row a slide: name, pairs, mean, max, std, signed mean, why refused; the paper's last."""
    rows: list[tuple[str, ...]] = []
    for slide in slides:
        pairs = slide.pairs
        figures = ("0", *[NOTHING] * 4)
        if pairs is not None:
            lengths = (pairs.mean_mm, pairs.max_mm, pairs.std_mm)
            figures = (str(pairs.n_pairs), *(f"{length:.4f}" for length in lengths), f"{pairs.signed_mean_mm:+.4f}")
        rows.append((slide.label, *figures, slide.not_judged or ""))
    if rows:
        rows.append(("paper, method 1", "25", *(f"{figure:.4f}" for figure in TABLE_5["1"]), NOTHING, ""))
    return rows
