"""Shared by all tests: the real recordings, where there are any, and settings of hypothesis for a noisy machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Two slow shared cores: time limits per example would fail at random, and only `make bench` judges time.
settings.register_profile("spherecal", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("spherecal")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings; tests that need it skip where SPHERECAL_REAL_DATA is unset."""
    folder = os.environ.get("SPHERECAL_REAL_DATA")
    if not folder:
        pytest.skip("SPHERECAL_REAL_DATA is unset: no real recordings here")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"SPHERECAL_REAL_DATA={folder!r} is no folder")
    return path
