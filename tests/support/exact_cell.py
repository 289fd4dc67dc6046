"""The demo cell without any error of the camera or noise, and other cameras that see the same as its simulated one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquire.capture import run_capture
from acquire.cell import Cell, load_cell, robot_model_of
from acquire.events import Captured
from acquire.session import SessionWriter
from acquire.sphere import SphereFinding
from drivers.kinematics import se3
from drivers.protocols import Camera3D, Devices
from drivers.simulated.camera import SimulatedCamera, frame_points
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.robot import SimulatedRobot
from drivers.simulated.scene import nearest_hits, ray_grid
from drivers.simulated.truth import NoError
from drivers.simulated.truth_file import load_truth
from measure.demo_cell import CALIBRATION_SPHERES, write_demo_cell
from measure.planning import PlanSettings, make_plan

SIZE_PX = (480, 300)


@dataclass(slots=True, eq=False)
class ExactCell:
    """A cell file, and the truth behind it."""

    cell: Cell
    world: SimulatedCell

    @classmethod
    def write(cls, folder: Path, seed: int) -> ExactCell:
        """The demo cell of a seed without its workpiece, its camera without noise or error, its spheres as their certificates say."""
        cell = load_cell(write_demo_cell(folder, seed=seed, resolution_px=SIZE_PX))
        truth = load_truth(folder / "truth.yaml")
        quiet = replace(truth.camera, range_noise_mm=0.0, flying_pixel_fraction=0.0, invalid_fraction=0.0, incidence_softness_deg=0.0)
        camera = replace(quiet, error=NoError())
        spheres = {name: replace(sphere, optical_offset_mm=0.0) for name, sphere in truth.spheres.items()}
        model = robot_model_of(cell)
        assert model is not None
        return cls(cell, SimulatedCell(replace(truth, camera=camera, spheres=spheres, workpiece=None), model, folder=folder))

    def expose(self) -> NDArray[np.float32]:
        """What the camera would see now, for cameras that are fed with it; no time passes."""
        truth, world = self.world.truth, self.world
        grid = ray_grid(truth.camera)
        hits = nearest_hits(truth, world.true_base_from_camera(), grid, world.mesh())
        return frame_points(truth.camera, grid, hits, np.random.default_rng(0))

    def simulated_camera(self) -> Camera3D:
        """The simulated camera itself."""
        return SimulatedCamera(self.world)

    def centre_errors_mm(self, camera: Camera3D, folder: Path, n_poses: int, seed: int) -> Iterator[float]:
        """A whole calibration capture: plan, motions, exposures, session. How far each found centre is from the exact one."""
        plan = make_plan(self.cell, PlanSettings("calibration", n_poses, CALIBRATION_SPHERES[:n_poses], seed=seed)).plan
        model = robot_model_of(self.cell)
        with Devices(SimulatedRobot(self.world), camera) as devices, SessionWriter.create(folder, purpose="calibration", cell=self.cell) as writer:
            for event in run_capture(devices, self.cell, plan, writer, model=model):
                if isinstance(event, Captured):
                    assert isinstance(event.finding, SphereFinding)
                    centre_in_base_mm = self.world.truth.spheres[str(event.shot.sphere)].centre_in_base_mm
                    exact_mm = se3.apply(se3.inverse(self.world.true_base_from_camera()), centre_in_base_mm)
                    yield float(np.linalg.norm(event.finding.centre_in_camera_mm - exact_mm))
