"""Sphere finding on many random cluttered scenes: never wrong, and blind only where the sphere is hidden."""

from __future__ import annotations

import numpy as np
import pytest

from acquire.sphere import SphereNotFound, find_sphere
from tests.support.random_scenes import random_scene

pytestmark = pytest.mark.qualify


@pytest.mark.parametrize("block", range(10))
def test_spheres_are_found_and_never_wrongly(block: int) -> None:
    for seed in range(50 * block, 50 * (block + 1)):
        scene = random_scene(seed)
        told = ""
        try:
            finding = find_sphere(scene.xyz_mm, radius_mm=scene.radius_mm, predicted_centre_in_camera_mm=scene.predicted_mm)
        except SphereNotFound as error:
            told = f"seed {seed}: {error.reason}: {error}"
        if told:
            assert scene.hidden > 0.5, told
            continue
        error_mm = float(np.linalg.norm(finding.centre_in_camera_mm - scene.centre_mm))
        assert error_mm < max(0.03, 7 * finding.centre_sigma_mm), f"seed {seed}: {error_mm:.3f} mm off"


@pytest.mark.parametrize("block", range(5))
def test_nothing_is_found_where_no_sphere_is(block: int) -> None:
    for seed in range(50 * block, 50 * (block + 1)):
        scene = random_scene(seed, with_sphere=False)
        with pytest.raises(SphereNotFound):
            find_sphere(scene.xyz_mm, radius_mm=scene.radius_mm, predicted_centre_in_camera_mm=scene.predicted_mm)
