"""LZF, the compression of PCD files: a byte that begins a run of literals, or a copy of what came before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.compiled import compiled


@compiled
def decompress(packed: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Unpack into `out`; the number of bytes written, or -1 where the packed bytes make no sense (M. Lehmann, liblzf)."""
    i, o = 0, 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            n = control + 1
            if i + n > len(packed) or o + n > len(out):
                return -1
            for k in range(n):
                out[o + k] = packed[i + k]
            i += n
        else:
            n = control >> 5
            if n == 7:
                if i >= len(packed):
                    return -1
                n += int(packed[i])
                i += 1
            if i >= len(packed):
                return -1
            start = o - ((control & 31) << 8) - int(packed[i]) - 1
            i += 1
            n += 2
            if start < 0 or o + n > len(out):
                return -1
            # byte by byte: source and target may overlap
            for k in range(n):
                out[o + k] = out[start + k]
        o += n
    return o
