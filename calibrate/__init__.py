"""The maths of spherecal: arrays in, result out; no device, no clock.

from calibrate import Calibration
calibration = Calibration.load("calibration.yaml")
"""

from calibrate.result import Calibration

__all__ = ["Calibration"]
