"""Sessions of joints and scans, or of poses and scans: every likely mistake is planted and must be named; none where there is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.observations import Observations, SphereShot
from calibrate.plausibility_causes import causes
from calibrate.plausibility_closure import check_closure, close, recorded, try_causes
from drivers.errors import DataError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.models import load_robot_model
from tests.support.solving import draw_shots
from tests.support.synthetic import PAPER_FLANGE_FROM_CAMERA, SyntheticCell, paper_cell, pillow_error_mm, with_table_1_errors

SEEDS = (101,)
UR10E = load_robot_model("ur10e")
CELLS = {
    "abb_irb1410": paper_cell(coupled=True),
    "ur10e": SyntheticCell(UR10E, with_table_1_errors(UR10E), PAPER_FLANGE_FROM_CAMERA, pillow_error_mm, np.array([700.0, 100.0, 300.0])),
}


@cache
def joints_of(robot: str, seed: int) -> FloatArray:
    """Axis angles (40, 6) that look at the sphere."""
    return np.array([shot.joints_rad for shot in draw_shots(CELLS[robot], np.random.default_rng(seed), 40, n_points=2)])


def shots_of(robot: str, seed: int, n: int = 24, *, pose_only: bool = False, cell: SyntheticCell | None = None) -> list[SphereShot]:
    """Noisy shots of one sphere; centres as good as a fit gives them."""
    cell, rng = cell or CELLS[robot], np.random.default_rng(seed)
    found = []
    for index, q in enumerate(joints_of(robot, seed)[:n]):
        noise = rng.normal(size=6) * [0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4]
        true_flange = cell.true_base_from_flange(q) @ se3.exp(noise)
        centre = se3.apply(se3.inverse(true_flange @ cell.flange_from_camera), cell.centre_in_base_mm)
        found.append(
            SphereShot(
                session="s",
                index=index,
                sphere="A",
                scan_sha256=str(index),
                joints_rad=None if pose_only else q,
                base_from_flange=true_flange if pose_only else mdh.base_from_flange(cell.nominal, q),
                points_in_camera_mm=np.zeros((0, 3)),
                radius_mm=cell.radius_mm,
                centre_in_camera_mm=centre + [0, 0, 1.0] * cell.camera_error_mm(centre[None]) + rng.normal(0, 0.02, 3),
            )
        )
    return found


def with_joints(shots: list[SphereShot], model: RobotModel, joints_rad: FloatArray) -> list[SphereShot]:
    poses = mdh.base_from_flange(model, joints_rad)
    return [replace(s, joints_rad=q, base_from_flange=pose) for s, q, pose in zip(shots, joints_rad, poses, strict=True)]


def with_poses(shots: list[SphereShot], change: Callable[[FloatArray], FloatArray]) -> list[SphereShot]:
    poses = change(np.array([shot.base_from_flange for shot in shots]))
    return [replace(shot, base_from_flange=pose) for shot, pose in zip(shots, poses, strict=True)]


def with_centres(shots: list[SphereShot], change: Callable[[FloatArray], FloatArray]) -> list[SphereShot]:
    centres = change(np.array([shot.centre_in_camera_mm for shot in shots]))
    return [replace(shot, centre_in_camera_mm=centre) for shot, centre in zip(shots, centres, strict=True)]


def told(shots: list[SphereShot], model: RobotModel | None) -> DataError:
    with pytest.raises(DataError) as error:
        check_closure([], Observations(tuple(shots), ()), model)
    assert error.value.remedy
    return error.value


def in_unit(factor: float) -> Callable[[FloatArray], FloatArray]:
    return lambda pose: se3.from_rotation_translation(pose[:, :3, :3], pose[:, :3, 3] * factor)


def turned(change: Callable[[Rotation], Rotation | FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """Poses with rotations made by a mistaken conversion."""

    def apply(pose: FloatArray) -> FloatArray:
        made = change(Rotation.from_matrix(pose[:, :3, :3]))
        return se3.from_rotation_translation(made.as_matrix() if isinstance(made, Rotation) else made, pose[:, :3, 3])

    return apply


def axis(i: int) -> FloatArray:
    return np.asarray(np.eye(6)[i - 1])


def opposite(i: int, q: FloatArray) -> FloatArray:
    return q * (1 - 2 * axis(i))


def quarter_turn(i: int, q: FloatArray) -> FloatArray:
    return q + np.pi / 2 * axis(i)


JOINT_MISTAKES: dict[str, tuple[Callable[[FloatArray], FloatArray], str]] = {
    "degrees": (np.degrees, "most likely the axis angles are in degrees"),
    "rad twice": (np.radians, "converted from degrees to rad twice"),
    "reverse order": (lambda q: q[:, ::-1], "reverse order"),
    "order of ROS": (lambda q: q[:, [2, 1, 0, 3, 4, 5]], "axes 1 and 3 are exchanged"),
    "wrist order": (lambda q: q[:, [0, 1, 2, 4, 3, 5]], "axes 4 and 5 are exchanged"),
    "last first": (lambda q: np.roll(q, 1, axis=1), "the last axis comes first"),
    **{f"sign of {i}": (partial(opposite, i), f"axis {i} is recorded with the opposite sign") for i in range(1, 7)},
    **{f"zero of {i}": (partial(quarter_turn, i), f"axis {i} has its zero 90 degrees off") for i in range(2, 6)},
}


@pytest.mark.parametrize("mistake", JOINT_MISTAKES)
@pytest.mark.parametrize("robot", CELLS)
def test_a_mistake_in_the_axis_angles_is_named(robot: str, mistake: str) -> None:
    spoil, words = JOINT_MISTAKES[mistake]
    model = CELLS[robot].nominal
    for seed in SEEDS:
        shots = shots_of(robot, seed)
        error = told(with_joints(shots, model, spoil(np.array([s.joints_rad for s in shots]))), model)
        assert words in error.message, seed
        assert "mm apart" in error.message


@pytest.mark.parametrize(
    ("robot", "taken", "words"),
    [
        ("abb_irb1410", replace(CELLS["abb_irb1410"].nominal, coupling=np.eye(6)), "theta_3 = q_3 - q_2 is missing"),
        ("ur10e", replace(UR10E, coupling=CELLS["abb_irb1410"].nominal.coupling), "coupling of the robot model does not belong"),
        ("abb_irb1410", load_robot_model("irb1410_paper"), "the robot is a abb_irb1410"),
        ("ur10e", load_robot_model("ur5e"), "the robot is a ur10e, not a ur5e"),
    ],
    ids=["uncoupled", "coupled", "paper", "ur5e"],
)
def test_a_wrong_robot_model_is_named(robot: str, taken: RobotModel, words: str) -> None:
    for seed in SEEDS:
        shots = shots_of(robot, seed)
        assert words in told(with_joints(shots, taken, np.array([s.joints_rad for s in shots])), taken).message, seed


POSE_MISTAKES: dict[str, tuple[Callable[[FloatArray], FloatArray], str]] = {
    "metres": (in_unit(1e-3), "the poses are in metres"),
    "inverse": (se3.inverse, "the poses are flange_from_base, the inverse"),
    "inverse in metres": (lambda t: in_unit(1e-3)(se3.inverse(t)), "flange_from_base in metres"),
    "transposed": (turned(lambda r: r.inv()), "rotations of the poses are transposed"),
    "moving for fixed": (turned(lambda r: Rotation.from_euler("XYZ", r.as_euler("xyz"))), "but they are about the fixed axes x, y, z"),
    "fixed for moving": (turned(lambda r: Rotation.from_euler("xyz", r.as_euler("XYZ"))), "but they are about x, y, z of the moving body"),
    "backwards": (turned(lambda r: Rotation.from_euler("xyz", r.as_euler("xyz")[:, ::-1])), "come in the order z, y, x"),
    "w first": (turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), 1, axis=1))), "read with w first, but it is last"),
    "w last": (turned(lambda r: Rotation.from_quat(np.roll(r.as_quat(), -1, axis=1))), "read with w last, but it is first"),
    "rad twice": (turned(lambda r: Rotation.from_euler("xyz", np.radians(r.as_euler("xyz")))), "from degrees to rad twice"),
}


@pytest.mark.parametrize("mistake", POSE_MISTAKES)
@pytest.mark.parametrize("robot", CELLS)
def test_a_mistake_in_recorded_poses_is_named(robot: str, mistake: str) -> None:
    spoil, words = POSE_MISTAKES[mistake]
    for seed in SEEDS:
        assert words in told(with_poses(shots_of(robot, seed, pose_only=True), spoil), None).message, seed


SCAN_MISTAKES: dict[str, tuple[Callable[[FloatArray], FloatArray], str]] = {
    "mirrored": (lambda c: c * [1, -1, 1], "mirrored"),
    "shift by one": (lambda c: np.roll(c, 1, axis=0), "scan i belongs to the pose of shot i-1"),
    "shift by two": (lambda c: np.roll(c, -2, axis=0), "shifted by 2 shots (scan i belongs to the pose of shot i+2)"),
    "reversed": (lambda c: c[::-1], "opposite order"),
}


@pytest.mark.parametrize("mistake", SCAN_MISTAKES)
@pytest.mark.parametrize("pose_only", [False, True], ids=["joints", "poses"])
@pytest.mark.parametrize("robot", CELLS)
def test_a_mistake_in_the_scans_is_named(robot: str, pose_only: bool, mistake: str) -> None:
    spoil, words = SCAN_MISTAKES[mistake]
    for seed in SEEDS:
        shots = with_centres(shots_of(robot, seed, pose_only=pose_only), spoil)
        assert words in told(shots, None if pose_only else CELLS[robot].nominal).message, seed


def hints(shots: list[SphereShot], model: RobotModel | None) -> dict[int, str]:
    return {index: text for (_, index), text in check_closure([], Observations(tuple(shots), ()), model).items()}


def with_centres_of(shots: list[SphereShot], order: list[int]) -> list[SphereShot]:
    return with_centres(shots, lambda centres: centres[order])


@pytest.mark.parametrize("pose_only", [False, True], ids=["joints", "poses"])
@pytest.mark.parametrize("robot", CELLS)
def test_exchanged_shots_are_named_both(robot: str, pose_only: bool) -> None:
    for seed in SEEDS:
        shots = shots_of(robot, seed, pose_only=pose_only)
        order = list(range(24))
        order[4], order[17], order[9], order[12] = 17, 4, 12, 9
        found = hints(with_centres_of(shots, order), None if pose_only else CELLS[robot].nominal)
        assert sorted(found) == [4, 9, 12, 17]
        for one, other in ((4, 17), (17, 4), (9, 12), (12, 9)):
            assert f"fits the pose of shot {other} and the other way round" in found[one]


def test_three_shots_that_went_round_are_told_one_by_one() -> None:
    order = list(range(24))
    order[3], order[8], order[15] = 8, 15, 3
    found = hints(with_centres_of(shots_of("ur10e", 5), order), UR10E)
    assert {index: text.split("shot ")[1] for index, text in found.items()} == {3: "8", 8: "15", 15: "3"}


def test_a_scan_of_another_sphere_is_told() -> None:
    other = replace(CELLS["ur10e"], centre_in_base_mm=np.array([640.0, 180.0, 340.0]))
    shots = shots_of("ur10e", 101, 12) + [
        replace(s, index=s.index + 12, sphere="B", scan_sha256=f"b{s.index}") for s in shots_of("ur10e", 101, 12, cell=other)
    ]
    shots[5] = replace(shots[5], sphere="B")
    assert hints(shots, UR10E) == {5: "its scan shows sphere A"}


@pytest.mark.parametrize("begins", [3, 8, 12, 16])
@pytest.mark.parametrize("by", [1, -1])
def test_a_list_that_slips_midway_is_told_from_which_shot_on(begins: int, by: int) -> None:
    """A scan that was lost (+1) or taken twice (-1)."""
    for robot, cell in CELLS.items():
        shots = shots_of(robot, 102, 24)
        order = [i if i < begins else min(max(i + by, 0), 23) for i in range(24)]
        message = told(with_centres_of(shots, order), cell.nominal).message
        named = f"shots {begins} to " in message or ("shifted by one shot" in message and begins < 5)
        assert named, (robot, message)
        assert f"i{by:+d}" in message


@pytest.mark.parametrize("n", [8, 10, 15])
@pytest.mark.parametrize("robot", CELLS)
def test_a_mistake_is_named_in_few_shots_of_which_one_is_bad(robot: str, n: int) -> None:
    model = CELLS[robot].nominal
    for seed in SEEDS:
        shots = shots_of(robot, seed, n)
        shots[3] = replace(shots[3], centre_in_camera_mm=np.array([30.0, 20.0, 300.0]))
        joints = np.array([s.joints_rad for s in shots])
        assert "axis 3 is recorded" in told(with_joints(shots, model, opposite(3, joints)), model).message, seed


def far_from_nominal(cell: SyntheticCell, rng: np.random.Generator) -> SyntheticCell:
    """A robot several mm and half a degree per link from its drawing."""
    true, n = cell.true, cell.true.n_joints
    parts = {"a_mm": 2.0, "d_mm": 2.0, "alpha_rad": 5e-3, "theta_offset_rad": 8e-3}
    return replace(cell, true=replace(true, **{name: getattr(true, name) + rng.normal(0, size, n) for name, size in parts.items()}))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [7, 9, 14, 40])
@pytest.mark.parametrize("robot", CELLS)
def test_right_data_raise_no_alarm(robot: str, n: int, seed: int) -> None:
    """A bad robot, one bad shot in ten, in few shots and many."""
    rng = np.random.default_rng(seed)
    cell = far_from_nominal(CELLS[robot], rng)
    shots = shots_of(robot, seed, n, cell=cell)
    for i in rng.choice(n, max(1, n // 10), replace=False):
        shots[i] = replace(shots[i], centre_in_camera_mm=shots[i].centre_in_camera_mm + rng.normal(0, 100, 3))
    assert check_closure([], Observations(tuple(shots), ()), cell.nominal) == {}
    data = recorded(shots, cell.nominal)
    # even where nothing obliges it to try, no mistake would explain right data much better than none
    assert min(t.spread_mm for t in try_causes(data)) > 0.4 * close(data).spread_mm[0]


def test_nonsense_is_not_named_but_what_was_tried_is() -> None:
    shots = with_centres(shots_of("ur10e", 7), np.random.default_rng(1).permutation)
    error = told(shots, UR10E)
    assert "most likely" not in error.message
    assert "no single mistake explains it" in error.message
    assert "degrees" in error.message


def test_every_cause_has_a_name_of_its_own() -> None:
    for pose_only in (False, True):
        data = recorded(shots_of("abb_irb1410", 1, 7, pose_only=pose_only), CELLS["abb_irb1410"].nominal)
        names = [cause.name for cause in causes(data)]
        doubled = {name for name in names if names.count(name) > 1}
        assert all("90 degrees off" in name for name in doubled)  # one way or the other
