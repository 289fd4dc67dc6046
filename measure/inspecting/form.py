"""Form: how far a surface bulges from its fitted shape, patch by patch so that noise does not pose as form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.inspecting.fitting import Fit, Response

_LEAST_SHARE = 0.25
"""Patches with fewer points than this share of the median one are rims, and left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """Highest patch less lowest."""

    form_mm: float
    noise_variance_mm2: float
    """Of that difference, by the scatter within the two patches."""
    by_patch: FloatArray
    """(K, 3) how that difference answers to displacements of the response's patches, the fit following them."""


def form_of(fit: Fit) -> Form:
    """The range of the mean residuals of a fit's patches."""
    enough = np.flatnonzero(fit.patch_count >= max(3.0, _LEAST_SHARE * float(np.median(fit.patch_count))))
    if len(enough) < 2:
        enough = np.arange(len(fit.patch_count))
    high = enough[np.argmax(fit.patch_residual_mm[enough])]
    low = enough[np.argmin(fit.patch_residual_mm[enough])]
    scatter = fit.rms_mm**2 * (1 / fit.patch_count[high] + 1 / fit.patch_count[low])
    by_patch = np.einsum("p,kpi->ki", fit.patch_jacobian[high] - fit.patch_jacobian[low], fit.response.by_patch)
    by_patch += fit.patch_motion[high] - fit.patch_motion[low]
    return Form(float(fit.patch_residual_mm[high] - fit.patch_residual_mm[low]), float(scatter), by_patch)


def with_form(response: Response, form: Form) -> Response:
    """A fit's response with its form as one more parameter."""
    by_patch = np.concatenate([response.by_patch, form.by_patch[:, None, :]], axis=1)
    return replace(response, by_patch=by_patch, outward=np.append(response.outward, 0.0))
