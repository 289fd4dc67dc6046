"""Fixture spheres in a part's own session: the calibration as it is for that part."""

from __future__ import annotations

from dataclasses import replace

from acquire.cell import cell_of_session, robot_model_of
from calibrate.part_correction import PartCorrection, correct_for_part
from calibrate.result import Calibration
from calibrate.second_look import see_sessions
from drivers.files.session import Session
from measure.placing import check_fits


def correct_by_session(calibration: Calibration, session: Session) -> PartCorrection:
    """Correct a calibration by the spheres that a workpiece's session shows, if those left out agree.

    Shots of spheres that the calibration has not seen tell nothing here and are passed over.

    Raises:
        DataError: the session does not fit the calibration, or the calibration has no axis angles.
        FileError: the session is broken.
    """
    cell = cell_of_session(session)
    check_fits(calibration, session, cell)
    known = set(calibration.sphere_centres_in_base_mm)
    kept = tuple(shot for shot in session.shots if shot.sphere in known)
    shots = see_sessions([replace(session, shots=kept)], cell=cell, model=robot_model_of(cell, session)).shots if kept else ()
    return correct_for_part(calibration, shots)
