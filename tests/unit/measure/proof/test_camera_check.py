"""Camera check: a bent camera is seen in fitted diameters at the size it has, whatever the robot is said to have done."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell
from acquire.session import SessionWriter
from acquire.sphere_fit import fit_free_radius
from drivers.errors import DataError, SettingsError
from drivers.files.session import Session, read_session
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import Devices, Frame3D
from measure.cli import app
from measure.cli_run import run_app
from measure.proof.camera_check import camera_check
from measure.proof.camera_sweep import SweepSettings, sweep
from tests.support.fake_devices import FakeCamera, FakeRobot, fake_cell
from tests.support.recorded import write_cell
from tests.support.scenes import frame, rays
from tests.support.synthetic import SyntheticCell, paper_cell

RADIUS_MM = 19.05


def cap(centre_mm: FloatArray, rng: np.random.Generator, n: int = 400) -> FloatArray:
    """Points of the side that a camera at the origin sees, up to 60 degrees of incidence."""
    towards = -centre_mm / np.linalg.norm(centre_mm)
    side = np.cross(towards, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    cosine, turn = rng.uniform(0.5, 1.0, n), rng.uniform(0, 2 * np.pi, n)
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(towards, side)
    return np.asarray(centre_mm + RADIUS_MM * (cosine[:, None] * towards + np.sqrt(1 - cosine**2)[:, None] * across))


def swept(folder: Path, cell: Cell, truth: SyntheticCell, places: FloatArray, *, noise_mm: float = 0.01, reads_large_mm: float = 0.0) -> Session:
    """A sphere carried through the view of a camera at rest: the same axis angles in every shot."""
    rng = np.random.default_rng(3)
    with SessionWriter.create(folder, purpose="verification", cell=cell) as writer:
        for place in places:
            points = place + (cap(place, rng) - place) * (1 + reads_large_mm / RADIUS_MM)
            points[:, 2] += truth.camera_error_mm(points) + rng.normal(0, noise_mm, len(points))
            writer.append(sphere="A", joints_rad=np.zeros(6), xyz_mm=points.astype(np.float32))
    return read_session(folder)


def grid(n_deep: int = 3) -> FloatArray:
    z = np.linspace(270, 420, n_deep)
    return np.array([[x, y, depth] for depth in z for x in (-60.0, 0.0, 60.0) for y in (-30.0, 0.0, 30.0)])


def no_error(cell: SyntheticCell) -> SyntheticCell:
    return replace(cell, camera_error_mm=lambda points: np.zeros(len(points)))


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A camera without error, in a cell without limits."""
    folder = tmp_path_factory.mktemp("right")
    return swept(folder / "s", write_cell(folder, limits=False), no_error(paper_cell()), grid(2))


def test_a_right_camera_conforms_and_the_figures_are_the_noise(right: Session) -> None:
    found = camera_check([right], limits=(0.1, 0.1))
    assert found.verdict == "conform", found.reasons
    assert np.abs(found.diameter_errors_mm).max() < 0.03
    assert len(found.places) == 18
    assert np.abs(found.centres_mm - grid(2)).max() < 0.05
    assert max(abs(slope) for slope in found.trend.per_100_mm) < 0.01
    # limits decide, and without any nothing is proven
    assert camera_check([right], limits=(0.2, 0.005)).verdict == "reject"
    assert "no limits given" in camera_check([right]).reasons


def test_a_bent_camera_shows_the_diameters_that_its_error_makes(tmp_path: Path) -> None:
    """Against free fits of noise-free points: the figures are the bend, and it runs with depth."""
    truth, rng = paper_cell(), np.random.default_rng(8)
    found = camera_check([swept(tmp_path / "s", write_cell(tmp_path), truth, grid(2))])
    expected = []
    for place in grid(2):
        points = cap(place, rng, 3000)
        points[:, 2] += truth.camera_error_mm(points)
        expected.append(2 * (fit_free_radius(points, RADIUS_MM, place)[1] - RADIUS_MM))
    assert np.ptp(expected) > 0.1
    assert np.abs(found.diameter_errors_mm - expected).max() < 0.03
    assert found.verdict == "reject"
    assert abs(found.trend.per_100_mm[2]) > 5 * abs(found.trend.per_100_mm[1])


def test_a_scale_error_shows_everywhere_alike(tmp_path: Path) -> None:
    found = camera_check([swept(tmp_path / "s", write_cell(tmp_path), no_error(paper_cell()), grid(2)[::2], reads_large_mm=0.1)])
    assert found.diameter_errors_mm.mean() == pytest.approx(0.2, abs=0.01)
    assert found.verdict == "reject"
    assert found.trend.left_mm < 0.02


def test_too_small_a_sweep_proves_nothing_and_says_what_is_wanted(tmp_path: Path) -> None:
    places = np.array([[x, 0.0, 300.0] for x in np.linspace(-60, 60, 9)])
    found = camera_check([swept(tmp_path / "s", write_cell(tmp_path), no_error(paper_cell()), places)], limits=(1.0, 1.0))
    assert found.verdict == "not_proven"
    assert any("in depth" in reason for reason in found.reasons)
    assert any("along y" in reason for reason in found.reasons)
    few = camera_check([swept(tmp_path / "few", write_cell(tmp_path), no_error(paper_cell()), grid()[:4])], limits=(1.0, 1.0))
    assert any("4 places" in reason for reason in few.reasons)


def test_a_line_profile_and_a_session_without_a_sphere_are_refused(tmp_path: Path) -> None:
    cell = write_cell(tmp_path / "line", kind="line_profile")
    with SessionWriter.create(tmp_path / "l", purpose="verification", cell=cell):
        pass
    with pytest.raises(SettingsError, match="arcs"):
        camera_check([read_session(tmp_path / "l")])
    with SessionWriter.create(tmp_path / "none", purpose="verification", cell=write_cell(tmp_path)) as writer:
        writer.append(sphere="A", joints_rad=np.zeros(6), status="failed", reason="no light")
    with pytest.raises(DataError, match="no light"):
        camera_check([read_session(tmp_path / "none")])


def test_the_command_prints_writes_a_page_and_tells_by_its_exit_code(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    swept(tmp_path / "<b>", write_cell(tmp_path), paper_cell(), grid(2)[::2])
    page = tmp_path / "page.html"
    assert run_app(app, ["camera-check", str(tmp_path / "<b>"), "--json", "--page", str(page)]) == 3
    data = json.loads(capfd.readouterr().out)
    assert (data["n_shots"], data["used"], data["verdict"]) == (9, 9, "reject")
    assert len(data["places"]) == 9
    text = page.read_text(encoding="utf-8")
    assert text.count("<svg") == 2
    assert "<link" not in text
    assert "<script" not in text
    assert "&lt;b&gt;: " in text
    assert run_app(app, ["camera-check", str(tmp_path / "<b>"), "--diameter-limit", "2"]) == 1
    assert "both limits" in capfd.readouterr().err


def test_a_cell_needs_a_folder_for_its_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    fake_cell(tmp_path)
    assert run_app(app, ["camera-check", str(tmp_path / "cell.yaml")]) == 1
    assert "no folder" in capfd.readouterr().err


class CarriedSphere(FakeCamera):
    """Somebody carries the sphere: at each place it is seen twice, now and then still in the hand."""

    def __init__(self, places: FloatArray) -> None:
        super().__init__()
        self.places = places
        self.shaken = {2, 3}

    def capture(self, *, timeout_s: float) -> Frame3D:
        n = self.sequence
        place = self.places[min(n // 2, len(self.places) - 1)] + (np.array([2.0 * (n % 2), 0, 0]) if n // 2 in self.shaken else 0.0)
        self.xyz_mm = frame([(place, RADIUS_MM)], sight=rays(160, 110, (22.0, 14.0)), noise_mm=0.02, seed=n)
        return super().capture(timeout_s=timeout_s)


def test_a_live_sweep_keeps_what_stands_still_at_new_places_and_moves_nothing(tmp_path: Path) -> None:
    places = np.array([[-40.0, 0, 300], [-40, 0, 301], [0, 0, 300], [10, 0, 330], [40, 20, 300], [0, -20, 380]])
    cell, robot = fake_cell(tmp_path), FakeRobot()
    devices, told = Devices(robot, CarriedSphere(places)), list[str]()
    with SessionWriter.create(tmp_path / "s", purpose="verification", cell=cell) as writer:
        kept = sweep(devices, cell, "A", writer, SweepSettings(n_places=9, every_s=1.0, give_up_s=8.0), told.append)
    assert kept == 3
    assert not robot.visited
    assert ["still" in line for line in told[2:4]] == [True, True]
    assert "seen here before" in told[1]
    check = camera_check([read_session(tmp_path / "s")], limits=(1.0, 1.0))
    assert np.abs(check.centres_mm - places[[0, 4, 5]]).max() < 0.3
