"""The one door to numba: typed decorators for per-point kernels.

Import this module, and modules that hold kernels, inside the function that needs them: numba costs half a second.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar, cast

# Open3D loads an older libtbb that numba refuses with a warning; OpenMP (libgomp1) works beside it.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
# Waiting threads that spin take the cores from whoever else computes: ten times slower on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba

Function = TypeVar("Function", bound=Callable[..., object])

parallel_range = numba.prange


def compiled(function: Function) -> Function:
    """Compile one kernel for one thread, cached on disk where the folder is writable."""
    return cast(Function, numba.njit(cache=True)(function))


def compiled_parallel(function: Function) -> Function:
    """Compile one kernel whose `parallel_range` loops run on all cores, cached on disk."""
    return cast(Function, numba.njit(cache=True, parallel=True)(function))
