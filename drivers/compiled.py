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

# Sums may be regrouped and divisions need no check for zero, without which loops do not use vector instructions; NaN and
# infinity keep their meaning. The grouping is fixed when the kernel is compiled, so results do not depend on threads.
_VECTOR_FLAGS = {"reassoc", "contract", "arcp", "nsz"}


def compiled(function: Function) -> Function:
    """Compile one kernel for one thread, cached on disk where the folder is writable; other threads run beside it."""
    return cast(Function, numba.njit(cache=True, nogil=True)(function))


def compiled_parallel(function: Function) -> Function:
    """Compile one kernel whose `parallel_range` loops run on all cores, cached on disk."""
    return cast(Function, numba.njit(cache=True, parallel=True)(function))


def vectorised(function: Function) -> Function:
    """As `compiled`, its loops free to use vector instructions."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_VECTOR_FLAGS)(function))


def vectorised_parallel(function: Function) -> Function:
    """As `compiled_parallel`, its loops free to use vector instructions."""
    return cast(Function, numba.njit(cache=True, parallel=True, error_model="numpy", fastmath=_VECTOR_FLAGS)(function))
