"""The figures that the paper prints (L. Wu et al., Sensors 2023, 23, 7447). Table 2 is left out: it cannot be right.

Twists of 0.49 rad, as printed there, would spread the sphere over 137-300 mm (METHOD.md 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

Triple = tuple[float, float, float]

TABLE_3: Mapping[str, Triple] = MappingProxyType(
    {"1": (0.2629, 0.2918, 0.0112), "2": (5.6545, 5.9715, 0.1831), "3": (2.5228, 3.5615, 0.5317), "4": (134.8228, 140.9125, 0.6630)}
)
"""e_mean, e_max, std in mm on 100 simulated tests."""
TABLE_5: Mapping[str, Triple] = MappingProxyType(
    {"1": (0.1232, 0.3137, 0.0957), "2": (0.1488, 0.3675, 0.1045), "3": (1.5457, 4.6076, 1.3503), "4": (0.1933, 0.4703, 0.1414)}
)
"""Mean, maximum and standard deviation of | |P1 - P2| - 50 | in mm over 25 pairs on hardware."""
STITCHED_DIAMETER_ERROR_MM: Mapping[str, float | None] = MappingProxyType({"1": 0.23, "2": 0.61, "3": None, "4": 0.57})
"""Section 4.2. The same sentence says that method 4 has no proper fit, so 0.57 may belong to another method."""
