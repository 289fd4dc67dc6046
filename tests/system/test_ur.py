"""Plan, capture, calibrate, verify with a UR behind the wire: the real ur_rtde client, a controller in its own process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import load_cell, robot_model_of
from acquire.events import Captured, Event
from acquire.plan import load_plan
from calibrate import Calibration
from drivers.errors import LinkLost, RobotTimeout
from drivers.files.session import read_scan, read_session
from measure.running import capture_session
from tests.support.driven import mark_driven
from tests.support.fake_ur import FakeUr, fake_ur, own_address
from tests.support.ur_cell import write_cells
from tests.system.conftest import Cli

N_CALIBRATION, N_VERIFICATION = 8, 3
MICROMETRE_MM = 1e-3


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Cell files, plain and wired."""
    return write_cells(tmp_path_factory.mktemp("ur"), controller=own_address(3), resolution_px=(160, 100), seed=11)


@pytest.fixture(scope="module")
def controller(cells: tuple[Path, Path]) -> Iterator[FakeUr]:
    """The controller, a hundred times as fast as a real one."""
    with fake_ur(own_address(3), "--cell", str(cells[1]), "--factory-calibration", "2", speed_up=100) as running:
        yield running


def test_the_whole_way_gives_what_the_plain_simulated_robot_gives(cells: tuple[Path, Path], controller: FakeUr, tmp_path: Path, cli: Cli) -> None:
    """Each session begins with a robot that never moved, as the plain one does.

    The cameras see from the same true places, so sessions agree to the last bit, and so do the results.
    """
    plain, wired = cells
    sessions: dict[str, list[Path]] = {"plain": [], "wired": []}
    for purpose, n, spheres in (("calibrate", N_CALIBRATION, "ABCD"), ("verify", N_VERIFICATION, "GH")):
        options = [part for name in spheres for part in ("--sphere", name)]
        plan = tmp_path / f"{purpose}.yaml"
        assert cli("plan", wired, "--for", purpose, "-n", n, *options, "-o", plan, "-q").code == 0
        for name, cell in (("plain", plain), ("wired", wired)):
            own = tmp_path / f"{purpose}_{name}.yaml"
            own.write_text(plan.read_text().replace(_digest(wired), _digest(cell)))
            out = tmp_path / f"{purpose}_{name}"
            mark_driven(cell, own)
            controller.bench.ask("home")
            result = cli("capture", cell, own, "-o", out, "--yes", "--json")
            assert result.code == 0, result.err
            assert result.told["n_shots"] == n
            sessions[name].append(out)
    for ours, theirs in zip(sessions["wired"], sessions["plain"], strict=True):
        _assert_same_session(ours, theirs)
    found = {}
    for name, (calibration, verification) in sessions.items():
        out = tmp_path / f"{name}_calibration.yaml"
        assert cli("calibrate", calibration, "-o", out, "--camera-error", "none", "-q").code in (0, 3)
        found[name] = Calibration.load(out)
        assert cli("verify", out, verification, "-q").code in (0, 3)
    joints = np.random.default_rng(5).uniform(-2, 2, (50, 6))
    flanges = [calibration.base_from_flange(joints) for calibration in found.values()]
    assert np.abs(flanges[0] - flanges[1])[..., :3, 3].max() < MICROMETRE_MM


def _digest(cell: Path) -> str:
    return load_cell(cell).sha256


def _assert_same_session(wired: Path, plain: Path) -> None:
    ours, theirs = read_session(wired), read_session(plain)
    assert len(ours.shots) == len(theirs.shots)
    for shot, other in zip(ours.shots, theirs.shots, strict=True):
        assert (shot.status, shot.pose_id, shot.sphere) == (other.status, other.pose_id, other.sphere)
        assert shot.joints_rad is not None
        assert other.joints_rad is not None
        np.testing.assert_allclose(shot.joints_rad, other.joints_rad, atol=1e-12)
        np.testing.assert_array_equal(read_scan(ours, shot).xyz_mm, read_scan(theirs, other).xyz_mm)


def test_a_run_whose_link_was_cut_is_gone_on_with(cells: tuple[Path, Path], controller: FakeUr, tmp_path: Path, cli: Cli) -> None:
    """Cut in mid-move after the first shot: the run ends in LinkLost, and `--resume` takes the poses that are left."""
    _, wired = cells
    plan, out = tmp_path / "plan.yaml", tmp_path / "session"
    assert cli("plan", wired, "--for", "verify", "-n", 3, "--sphere", "G", "-o", plan, "-q").code == 0
    loaded = load_cell(wired)
    poses = load_plan(plan, loaded, robot_model_of(loaded))

    def cut(event: Event) -> None:
        if isinstance(event, Captured):
            controller.fault("drop_at_command")

    with pytest.raises((LinkLost, RobotTimeout)):
        capture_session(loaded, poses, out, watcher=cut)
    controller.clear()
    before = controller.n_motions()
    assert len(read_session(out).shots) == 1
    mark_driven(wired, plan)
    told = cli("capture", wired, plan, "-o", out, "--yes", "--resume", "--json").told
    assert (told["n_shots"], told["state"]) == (3, "complete")
    assert controller.n_motions() >= before + 2
