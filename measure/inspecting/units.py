"""Units that do not agree: cloud and nominal, nominal and inspection file; told before anything is fitted."""

from __future__ import annotations

import numpy as np

from drivers.errors import DataError, FileError
from measure.inspecting.cloud import MeasuredCloud
from measure.inspecting.nominal import Nominal
from measure.inspecting.spec import InspectionSpec

_UNITS = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0}
_FEWEST_FEATURES = 3
"""One or two may lie far away for other reasons; they are not found then, which is told."""


def require_likely_units(cloud: MeasuredCloud, nominal: Nominal) -> None:
    """Refuse a cloud and a nominal whose sizes differ as units do.

    Raises:
        DataError: factor 1000, 25.4 or 10 between them.
    """
    low, high = np.quantile(cloud.points_mm, [0.005, 0.995], axis=0)
    sizes, drawn = np.sort(high - low), np.sort(np.ptp(nominal.box_mm, axis=0))
    ratio = float(sizes[-1] / max(drawn[-1], 1e-9))
    if ratio < 1 / 200:
        raise DataError(
            f"the cloud is {sizes[-1]:.3g} long, the nominal {drawn[-1]:.3g}: the cloud is probably in metres",
            file=cloud.file,
            remedy="Clouds and nominals are in mm.",
        )
    if ratio > 200:
        raise DataError(
            f"the cloud is {sizes[-1]:.3g} mm long, the nominal {drawn[-1]:.3g}: the nominal is probably in metres",
            file=nominal.file,
            remedy="Export it in mm.",
        )
    units = [(_UNITS[name], name) for name in ("inches", "centimetres")]
    told = [(factor, f"the nominal is probably in {name}") for factor, name in units]
    told += [(1 / factor, f"the cloud is probably in {name}") for factor, name in units]
    for factor, words in told:
        if np.allclose(sizes / np.maximum(drawn, 1e-9), factor, rtol=0.03):
            raise DataError(f"the cloud is {ratio:.3g} times as large as the nominal in every direction: {words}", file=cloud.file, remedy="Use mm.")


def require_features_on(nominal: Nominal, spec: InspectionSpec) -> None:
    """Refuse a mesh that is so much smaller than the place where its features are drawn as another unit makes it.

    Raises:
        FileError: names the unit.
    """
    if len(spec.features) < _FEWEST_FEATURES:
        return
    low, high = nominal.box_mm
    slack = max(0.5 * float((high - low).max()), 2.0 * max(feature.search_mm for feature in spec.features.values()))
    centres = np.array([feature.centre_mm for feature in spec.features.values()])
    outside = ((centres < low - slack) | (centres > high + slack)).any(axis=1)
    ratio = float(np.abs(centres).max() / np.abs(nominal.box_mm).max())
    unit = min(_UNITS, key=lambda name: abs(np.log(ratio / _UNITS[name])))
    if outside.mean() > 0.5 and 0.5 < ratio / _UNITS[unit] < 1.5:
        raise FileError(
            f"{int(outside.sum())} of {len(centres)} features are drawn outside of the mesh: it is probably in {unit}",
            file=nominal.file,
            remedy="Export it in mm.",
        )
