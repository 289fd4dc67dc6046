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
DIAMETER_ERROR_BELOW_MM = 0.4
"""Section 4.1 of Fig 5: "The maximum fitted diameter error is less than 0.4 mm in the experiment"."""
CAMERA_ERROR_MAX_MM = 1.6
"""Section 4.1 of Fig 6d: "a maximum of 1.6 mm camera error is added in the simulation"."""
NEGATIVE_EFFECT_MM = 0.2
"""Section 3.3 of Fig 8: "method 2 exhibits a negative effect when the camera error exceeds 0.2 mm"."""
HAND_EYE_TRUE_MM, HAND_EYE_BEFORE_MM, HAND_EYE_FOUND_MM = (60.0, 60.0, 85.0), (59.5445, 61.3253, 86.2298), (59.7917, 60.0563, 84.9688)
"""Translations of the simulation's hand-eye transform (METHOD.md 6), of the printed first guess and of the printed result, section 3.1."""
HARDWARE_HAND_EYE_MM = ((57.4017, 61.1012, 86.1401), (57.2041, 60.9219, 86.5221))
"""Translations before and after, section 4.1."""
SIMULATED_K = (-9.60e-10, -7.32e-15, -4.94e-18)
"""Table 2's last row, a correction: near the negative of the simulated error, as section 3.1 says. Minus signs of exponents are
lost in our text of the paper and were put back; its twists are not used (see above)."""
HARDWARE_K = (7.02e-28, 4.32e-23, 7.58e-18)
"""Table 4's last row, likewise."""
