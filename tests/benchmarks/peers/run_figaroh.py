"""figaroh's `map` on sphere centres, in an environment of its own: `python run_figaroh.py task.npz answer.npz`.

figaroh knows a robot that carries a marker, seen by a fixed camera. A camera on the flange that sees a fixed sphere is
the same chain read backwards: the camera is the world (`base_*` is the hand-eye transform), the robot's base is the end,
the spheres are markers on it, and the axes turn the other way. Everything else is the package's own: every joint
parameter with its default priors, frames free, noise estimated, outliers cut at a fixed distance.

The residual is the plain difference of positions, or with the setting `log_map` the one of figaroh's own guide, which
gives the same for positions and takes five times as long (it makes a pose of every position, in Python). Several spheres,
of which a shot sees one, and certified lengths are rows of the same residual.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin  # type: ignore[import-not-found]
import yaml
from figaroh.calibration.base_calibration import BaseCalibration  # type: ignore[import-not-found]
from figaroh.calibration.calibration_tools import calc_updated_fkm  # type: ignore[import-not-found]
from pinocchio.robot_wrapper import RobotWrapper  # type: ignore[import-not-found]

MM = 1e-3
FIRST_NOISE_M = 1e-4


def reversed_chain(task: dict[str, Any]) -> Any:
    """A pinocchio model from flange to base: T_i^-1 = TransZ(-d) RotZ(-theta) TransX(-a) RotX(-alpha), i = n ... 1."""
    model = pin.Model()
    model.name = "reversed"
    parent, before = 0, pin.SE3.Identity()
    for i in range(len(task["a_mm"]) - 1, -1, -1):
        shift = pin.SE3(np.eye(3), np.array([0.0, 0.0, -task["d_mm"][i] * MM]))
        turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, -task["theta_offset_rad"][i]), np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), before * shift * turn, f"axis{i + 1}")
        along = pin.SE3(np.eye(3), np.array([-task["a_mm"][i] * MM, 0.0, 0.0]))
        before = along * pin.SE3(pin.rpy.rpyToMatrix(-task["alpha_rad"][i], 0.0, 0.0), np.zeros(3))
    model.addFrame(pin.Frame("robot_base", parent, 0, before, pin.FrameType.OP_FRAME))
    return RobotWrapper(model)


def write_inputs(task: dict[str, Any], folder: Path) -> Path:
    """Configuration and measurements as figaroh reads them; markers that a shot does not see hold zeros."""
    n_axes, n_spheres = len(task["a_mm"]), len(task["sphere_names"])
    names = [f"axis{i}" for i in range(n_axes, 0, -1)]
    columns = [f"{axis}{s + 1}" for s in range(n_spheres) for axis in "xyz"] + names
    rows = np.zeros((len(task["theta_rad"]), len(columns)))
    for j, s in enumerate(task["sphere"]):
        rows[j, 3 * s : 3 * s + 3] = task["centre_in_camera_mm"][j] * MM
    rows[:, 3 * n_spheres :] = -task["theta_rad"][:, ::-1]
    np.savetxt(folder / "data.csv", rows, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
    marker = {"name": "sphere", "measurable_dof": [True] * 3 + [False] * 3}
    calibration = {
        "enabled": True,
        "parameters": {"calibration_level": "full_params", "estimation": {"method": "map"}},
        "kinematics": {"base_frame": "universe", "tool_frame": "robot_base"},
        "joints": {"active_joints": names},
        "measurements": {"markers": [marker] * n_spheres, "poses": {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6}},
        "data": {"source_file": str(folder / "data.csv"), "number_of_samples": len(rows)},
    }
    config = {"_metadata": {"schema_version": "2.0"}, "robot": {"name": "reversed"}, "tasks": {"calibration": calibration}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder / "config.yaml"


class SphereCalibration(BaseCalibration):  # type: ignore[misc]
    """The subclass that figaroh asks its users to write."""

    def __init__(self, robot: Any, config: Path, task: dict[str, Any]) -> None:
        super().__init__(robot, str(config))
        self.PEE_measured: Any = None
        self.task = task
        self.calib_config["known_baseframe"] = self.calib_config["known_tipframe"] = False
        self.n_spheres = len(task["sphere_names"])
        n = len(task["sphere"])
        self.rows = (task["sphere"] * 3 * n + np.arange(3)[:, None] * n + np.arange(n)).ravel()
        self.evaluations = 0

    def load_data_set(self) -> None:
        super().load_data_set()
        if self.n_spheres > 1:  # the marker that was seen stands for all
            n = len(self.task["sphere"])
            self.PEE_measured = self.PEE_measured.reshape(self.n_spheres, 3, n)[self.task["sphere"], :, np.arange(n)].T.ravel()

    def seen(self, var: Any) -> Any:
        """Predicted positions of the spheres that were seen; samples of an estimation fold follow NbSample."""
        self.evaluations += 1
        predicted = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return predicted if self.n_spheres == 1 else predicted[self.rows]

    def cost_function(self, var: Any) -> Any:
        if self.task.get("log_map"):
            return self.apply_measurement_weighting(super()._compute_logmap_residuals(self.PEE_measured, self.seen(var)))
        return np.concatenate([self.seen(var) - self.PEE_measured, self.length_rows(var)])

    def length_rows(self, var: Any) -> Any:
        """Certified lengths, weighted against a measured coordinate's noise."""
        values = dict(zip(self.calib_config["param_name"], var, strict=True))
        noise = (self.calib_config.get("estimation_report") or {}).get("noise_std", FIRST_NOISE_M)
        rows = []
        for (a, b), length, sigma in zip(self.task["length_ends"], self.task["length_mm"], self.task["length_sigma_mm"], strict=True):
            ends = [np.array([values[f"pEE{axis}_{s + 1}"] for axis in "xyz"]) for s in (a, b)]
            rows.append((np.linalg.norm(ends[0] - ends[1]) - length * MM) * noise / (sigma * MM))
        return np.array(rows)

    def get_pose_from_measure(self, res_: Any) -> Any:
        return self.seen(res_)

    def _compute_logmap_residuals(self, measured_flat: Any, estimated_flat: Any, **_: Any) -> Any:
        return estimated_flat - measured_flat

    def initial_frame_guess(self) -> dict[str, float]:
        """figaroh's closed form for one sphere; it has none for markers seen one at a time: the nominal chain then."""
        if self.n_spheres == 1:
            guess: dict[str, float] = super().initial_frame_guess()
            return guess
        camera_from_flange = np.linalg.inv(self.task["flange_from_camera"])
        turn = pin.rpy.matrixToRpy(camera_from_flange[:3, :3])
        names = ["base_px", "base_py", "base_pz", "base_phix", "base_phiy", "base_phiz"]
        result = dict(zip(names, [*(camera_from_flange[:3, 3] * MM), *turn], strict=True))
        for s, centre in enumerate(self.task["first_centres_mm"]):
            result |= {f"pEE{axis}_{s + 1}": value * MM for axis, value in zip("xyz", centre, strict=True)}
        return result

    def base_from_camera(self, var: Any, theta_rad: Any) -> Any:
        """(k, 4, 4) in mm: the fitted chain without the spheres, turned round."""
        keep = [i for i, name in enumerate(self.calib_config["param_name"]) if "EE" not in name]
        config = dict(self.calib_config, NbMarkers=1, NbSample=len(theta_rad), measurability=[True] * 6, calibration_index=6)
        config["param_name"] = [self.calib_config["param_name"][i] for i in keep]
        poses = calc_updated_fkm(self.model, self.data, np.asarray(var)[keep], -theta_rad[:, ::-1][:, self.axis_order()], config)
        result = np.tile(np.eye(4), (len(theta_rad), 1, 1))
        for j, pose in enumerate(poses.reshape(6, -1).T):
            base_from_camera = pin.SE3(pin.rpy.rpyToMatrix(pose[3:]), pose[:3]).inverse()
            result[j, :3, :3], result[j, :3, 3] = base_from_camera.rotation, base_from_camera.translation / MM
        return result

    def axis_order(self) -> list[int]:
        """Columns of reversed axis angles in the order of the model's configuration."""
        names = [f"axis{i}" for i in range(self.model.nq, 0, -1)]
        return [names.index(name) for name in list(self.model.names)[1:]]


def solved(task: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """An answer per outlier threshold; each is timed with the choice of parameters. Building the model is not timed."""
    calibration = SphereCalibration(reversed_chain(task), write_inputs(task, folder), task)
    calibration.load_data_set()
    began = time.perf_counter()
    calibration.create_param_list()
    chosen_s, chosen_in = time.perf_counter() - began, calibration.evaluations
    answers = []
    for threshold_mm in task.get("outlier_thresholds_mm", [None]):
        calibration.evaluations = 0
        began = time.perf_counter()
        result, excluded = calibration.solve_optimisation(outlier_threshold=None if threshold_mm is None else threshold_mm * MM)
        seconds = chosen_s + time.perf_counter() - began
        answers.append({
            "seconds": seconds,
            "n_parameters": len(result.x),
            "evaluations": chosen_in + calibration.evaluations,
            "success": bool(result.success),
            "excluded": len(excluded),
            "base_from_camera": calibration.base_from_camera(result.x, task["test_theta_rad"]),
        })  # fmt: skip
    return answers


def main() -> None:
    warnings.simplefilter("ignore")
    data = np.load(sys.argv[1])
    task: dict[str, Any] = {name: data[name] for name in data.files if name != "settings"} | json.loads(str(data["settings"]))
    with tempfile.TemporaryDirectory() as folder:
        runs = [solved(task, Path(folder)) for _ in range(task.get("repeats", 1))]
    answers = runs[-1]
    for i, answer in enumerate(answers):
        answer["seconds"] = min(run[i]["seconds"] for run in runs)
    columns: dict[str, Any] = {key: np.array([answer[key] for answer in answers]) for key in answers[0]}
    np.savez(sys.argv[2], **columns)


if __name__ == "__main__":
    main()
