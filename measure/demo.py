"""The whole way on a simulated cell, by the same pieces that the commands use: plan, capture, calibrate, verify, stitch.

What it writes into its folder can be looked at and used again with every command. `calibrate` is given session folders
and nothing else; the truth lies in a file that only the simulated devices open.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from acquire.cell import Cell, load_cell, robot_model_of
from acquire.events import Command, Event
from acquire.plan import load_plan, write_plan
from calibrate import Calibration
from calibrate.second_look import see_sessions
from calibrate.solve import calibrate
from drivers.files.disk import write_text_atomic
from drivers.files.session import read_session
from measure.console import json_text
from measure.demo_cell import (
    CALIBRATION_SPHERES,
    RESOLUTION_PX,
    VERIFICATION_SPHERES,
    WORKPIECE_CENTRE_MM,
    WORKPIECE_SIZE_MM,
    write_demo_cell,
)
from measure.planning import PlanSettings, Purpose, make_plan
from measure.report import write_report
from measure.run_scene import scene_of
from measure.running import capture_session
from measure.stitch import StitchResult, stitch
from measure.verify import verify
from measure.verify_result import VerifyResult
from measure.viewer import write_recording

VOXEL_MM = 0.5
_REGION_MARGIN_MM = 15.0


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """Sizes of the demo."""

    seed: int = 0
    n_calibration: int = 60
    n_verification: int = 32
    n_workpiece: int = 12
    resolution_px: tuple[int, int] = RESOLUTION_PX


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """What the demo found."""

    calibration: Calibration
    verification: VerifyResult
    stitched: StitchResult
    seconds: float

    def to_json_dict(self, folder: Path) -> dict[str, object]:
        """What `spherecal demo --json` prints; `folder` is where the files lie now."""
        return {
            "calibrate": {**self.calibration.to_json_dict(), "out": folder / "calibration.yaml"},
            "verify": self.verification.to_json_dict(),
            "stitch": {**self.stitched.to_json_dict(), "out": folder / self.stitched.out.name},
            "out": folder,
            "seconds": self.seconds,
        }


def run_demo(folder: Path, settings: DemoSettings, tell: Callable[[str], None]) -> DemoResult:
    """Fill an empty folder with cell, truth, plans, sessions, calibration, verification, cloud, report and recording.

    Args:
        folder: empty.
        settings: sizes and seed.
        tell: told, in words, what comes next.

    Raises:
        FileError: the folder cannot be written.
    """
    began = time.perf_counter()
    cell = load_cell(write_demo_cell(folder, settings.seed, settings.resolution_px))
    plans = (
        PlanSettings("calibration", settings.n_calibration, CALIBRATION_SPHERES, seed=settings.seed),
        PlanSettings("verification", settings.n_verification, VERIFICATION_SPHERES, seed=settings.seed),
        PlanSettings("workpiece", settings.n_workpiece, region_mm=workpiece_region_mm(), seed=settings.seed),
    )
    for plan in plans:
        tell(f"{plan.purpose}: planning and capturing {plan.n_poses} poses")
        _plan_and_capture(cell, plan, folder)
    tell(f"calibration: solving robot, hand-eye and camera together from {settings.n_calibration} shots of the ball bar")
    session = read_session(folder / "calibration")
    calibration = calibrate([session])
    calibration.save(folder / "calibration.yaml")
    tell("verification: judging the result on spheres, lengths and poses that the calibration never saw")
    verification = verify(calibration, [read_session(folder / "verification")])
    write_text_atomic(folder / "verification.json", json_text(verification.to_json_dict()) + "\n")
    tell("workpiece: stitching the scans in the robot base")
    stitched = stitch(calibration, read_session(folder / "workpiece"), folder / "cloud.ply", VOXEL_MM)
    tell("writing report.html and run.rrd")
    _write_pictures(folder, cell, calibration, verification, stitched)
    return DemoResult(calibration, verification, stitched, time.perf_counter() - began)


def workpiece_region_mm() -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(2, 3) box round the workpiece, turned as it is."""
    half = np.hypot(*WORKPIECE_SIZE_MM[:2]) / 2 + _REGION_MARGIN_MM
    x, y, z = WORKPIECE_CENTRE_MM
    return np.array([[x - half, y - half, z], [x + half, y + half, z + WORKPIECE_SIZE_MM[2]]])


def _plan_and_capture(cell: Cell, settings: PlanSettings, folder: Path) -> None:
    path = folder / _plan_name(settings.purpose)
    write_plan(make_plan(cell, settings).plan, path)
    plan = load_plan(path, cell, robot_model_of(cell))
    capture_session(cell, plan, folder / settings.purpose, watcher=_nothing)


def _plan_name(purpose: Purpose) -> str:
    return f"plan_{purpose}.yaml"


def _nothing(_event: Event) -> Command | None:
    return None


def _write_pictures(folder: Path, cell: Cell, calibration: Calibration, verification: VerifyResult, stitched: StitchResult) -> None:
    sessions = {name: read_session(folder / name) for name in ("calibration", "verification", "workpiece")}
    names = {session.digest: name for name, session in sessions.items()}
    write_report(folder / "report.html", calibration, verification, cell=cell, session_names=names)
    shots = see_sessions([sessions["calibration"]], cell=cell, model=robot_model_of(cell)).shots
    cloud = stitched.cloud.points_mm
    scene = scene_of(calibration, cell, shots, verification=verification, workpiece=sessions["workpiece"], stitched_in_base_mm=cloud)
    write_recording(folder / "run.rrd", scene)
