"""Which shots tell most about lengths in the work volume, and how good a calibration they will make.

Everything is first order and needs no data: the information of ideal caps at the nominal state, priors as the solver
has them, certified lengths as rows. What no model describes is carried through the solve's own gain
(`calibrate.design_mismatch`), so that a figure is what will be seen and not what noise alone would leave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.design_aim import Aim
from calibrate.design_search import IndexArray, Information, Pool, exchanged, greedy, mean_square, scores
from calibrate.design_shots import IntArray, Scene, actual_covariance, layout_of, n_columns, prior_sigma, shot_rows
from drivers.errors import SettingsError
from drivers.kinematics.se3 import FloatArray

SWEEPS = 2
_FEWEST_SHARE = 0.5
"""Every sphere gets at least this part of an even share."""


@dataclass(frozen=True, slots=True)
class Predicted:
    """What a set of shots will make of the work volume, one standard deviation."""

    n_shots: int
    length_rms_mm: float
    """Of lengths over the work volume, places seen from several views; what unmodelled physics adds is in it."""
    length_noise_rms_mm: float
    """The part that noise and priors leave: all there is in a cell that the models describe."""
    length_mismatch_rms_mm: float
    """The part of the unmodelled physics, of stated size."""
    centre_rms_mm: float | None
    """Of the centre of one view about the mean of many, with its own noise; None for line profiles."""

    def to_json_dict(self) -> dict[str, object]:
        """For plan files and `--json`."""
        return {
            "centre_rms_mm": None if self.centre_rms_mm is None else round(self.centre_rms_mm, 5),
            "length_rms_mm": round(self.length_rms_mm, 5),
            "length_noise_rms_mm": round(self.length_noise_rms_mm, 5),
            "length_mismatch_rms_mm": round(self.length_mismatch_rms_mm, 5),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """Chosen shots."""

    rows: IndexArray
    """(n,) of the candidates, in the order in which they were found to tell most."""
    information: Information
    predicted: Predicted


def information_before(scene: Scene) -> Information:
    """Priors and certified lengths alone."""
    sigma = prior_sigma(scene)
    layout = layout_of(scene)
    none = np.zeros((len(sigma), n_columns(scene) - len(sigma)))
    start = Information(np.diag(sigma**-2.0), none, sigma, actual_covariance(scene))
    rows = np.zeros((len(scene.lengths), n_columns(scene)))
    for row, length in zip(rows, scene.lengths, strict=True):
        way = scene.centres_in_base_mm[length.second] - scene.centres_in_base_mm[length.first]
        for index, sign in ((length.first, -1.0), (length.second, 1.0)):
            begin = layout.centres.start + 3 * index
            row[begin : begin + 3] = sign * way / np.linalg.norm(way) / length.sigma_mm
    return start.plus(rows)


def information_of(scene: Scene, joints_rad: FloatArray, sphere: IntArray) -> Information:
    """Priors, lengths, and shots with joints (m, n) at spheres (m,)."""
    return information_before(scene).plus(shot_rows(scene, joints_rad, sphere))


def predicted_of(information: Information, aim: Aim, n_shots: int) -> Predicted:
    """The figures of an information."""
    lengths, centres = mean_square(information, aim.lengths), mean_square(information, aim.centres)
    # rows of `centres` are components, of which a centre has three
    centre = float(np.sqrt(3 * centres.total_mm2 + aim.centre_noise_mm2))
    return Predicted(
        n_shots=n_shots,
        length_rms_mm=float(np.sqrt(lengths.total_mm2)),
        length_noise_rms_mm=float(np.sqrt(lengths.modelled_mm2)),
        length_mismatch_rms_mm=float(np.sqrt(lengths.mismatch_mm2)),
        centre_rms_mm=centre if np.isfinite(centre) else None,
    )


def predicted_of_shots(scene: Scene, aim: Aim, joints_rad: FloatArray, sphere: IntArray) -> Predicted:
    """What a set of shots, taken or only planned, will make of the work volume.

    Args:
        scene: robot, camera and spheres.
        aim: where accuracy matters.
        joints_rad: (m, n).
        sphere: (m,) index of each shot's sphere.
    """
    return predicted_of(information_of(scene, joints_rad, sphere), aim, len(joints_rad))


def choose_shots(
    scene: Scene, aim: Aim, joints_rad: FloatArray, sphere: IntArray, n: int, *, already: Information | None = None, sweeps: int = SWEEPS
) -> Design:
    """The n of some candidates that leave the least error of lengths: greedily, then by exchanges.

    The same candidates in another order make the same choice.

    Args:
        scene: robot, camera and spheres.
        aim: where accuracy matters.
        joints_rad: (m, n_axes) of the candidates.
        sphere: (m,) index of the sphere that each looks at.
        n: how many to choose.
        already: shots that are taken, or none.
        sweeps: rounds of exchanges at most.

    Raises:
        SettingsError: fewer candidates than wanted.
    """
    if n > len(joints_rad):
        raise SettingsError(f"{n} shots are wanted and {len(joints_rad)} are feasible", remedy="Draw more candidates, or ask for fewer shots.")
    own_order = np.lexsort((*joints_rad.T[::-1], sphere))
    pool = Pool(shot_rows(scene, joints_rad[own_order], sphere[own_order]), sphere[own_order])
    fewest = min(max(3, int(_FEWEST_SHARE * n / len(scene.radius_mm))), n // len(scene.radius_mm))
    chosen, information = greedy(already or information_before(scene), aim.lengths, pool, n, fewest)
    chosen, information = exchanged(information, aim.lengths, pool, chosen, fewest, sweeps)
    return Design(own_order[chosen], information, predicted_of(information, aim, n))


def best_next(scene: Scene, aim: Aim, information: Information, joints_rad: FloatArray, sphere: IntArray, n: int = 1) -> IndexArray:
    """The n candidates (rows), best first, each of which by itself lowers the error of lengths most after the shots so far.

    Args:
        scene: robot, camera and spheres.
        aim: where accuracy matters.
        information: of the shots so far, e.g. `information_of`.
        joints_rad: (m, n_axes) of the candidates.
        sphere: (m,) index of the sphere that each looks at.
        n: how many.
    """
    found = scores(information, aim.lengths, shot_rows(scene, joints_rad, sphere))
    return np.asarray(np.lexsort((*joints_rad.T[::-1], found))[:n], dtype=np.intp)
