"""Pictures: valid, self-contained SVG, the same for the same data, no clash of ids on one page."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from calibrate.camera_field import CameraField
from measure import plots, plots_maps


def depth_slice(depth_mm: float, slope: float) -> plots_maps.DepthSlice:
    x, y = np.linspace(-100, 100, 21), np.linspace(-60, 60, 13)
    points = plots_maps.grid_mm(x, y, depth_mm)
    field = CameraField(slope * points, np.tile(1e-6 * np.eye(3), (len(points), 1, 1)), points[:, 0] < 40)
    return plots_maps.DepthSlice.of_field(depth_mm, x, y, field)


def profile(label: str) -> plots_maps.DepthProfile:
    depth = np.linspace(250.0, 450.0, 30)
    return plots_maps.DepthProfile(label, depth, np.sin(depth), np.full(30, 0.1), depth < 400)


def pictures() -> dict[str, str]:
    rng = np.random.default_rng(0)
    before, after = rng.normal(0, 1.4, (40, 3)), rng.normal(0, 0.03, (40, 3))
    camera = rng.uniform([-120, -70, 260], [120, 70, 420], (60, 3))
    seen = np.array([camera.min(axis=0), camera.max(axis=0)])
    series = plots.ShotSeries("calibration", np.arange(40.0), np.abs(after[:, 0]), plots.AFTER_COLOUR)
    bars = [plots.LengthBar("A-B", 0.03, 0.06), plots.LengthBar("C-D", -0.08, 0.06)]
    return {
        "centres": plots.centres_svg(before, after, axes=(0, 1)),
        "centres alone": plots.centres_svg(None, after, axes=(0, 2)),
        "shots": plots.shots_svg([series], rejected=np.array([3.0]), ylabel="distance, mm", limit_mm=0.1),
        "no shots": plots.shots_svg([], rejected=np.zeros(0), ylabel="radial rms, mm"),
        "coverage": plots.coverage_svg({"calibration": (camera, plots.AFTER_COLOUR)}, axis=1, working_range_mm=(250, 450), seen_mm=seen),
        "depth": plots_maps.depth_slices_svg([depth_slice(z, 1e-3) for z in (280.0, 340.0, 400.0)]),
        "no depth error": plots_maps.depth_slices_svg([depth_slice(340.0, 0.0)]),
        "profiles": plots_maps.depth_profiles_svg([profile(name) for name in ("left", "right")]),
        "budget": plots_maps.budget_map_svg(np.arange(5.0), np.arange(4.0), np.where(rng.random((4, 5)) < 0.2, np.nan, rng.random((4, 5)))),
        "no budget": plots_maps.budget_map_svg(np.arange(2.0), np.arange(2.0), np.zeros((2, 2))),
        "lengths": plots.lengths_svg(bars, {"A-B": 1.2}, limit_mm=0.2),
    }


@pytest.fixture(scope="module")
def drawn() -> dict[str, str]:
    return pictures()


def test_every_picture_is_one_svg_that_needs_nothing_else(drawn: dict[str, str]) -> None:
    for name, svg in drawn.items():
        root = ET.fromstring(svg)
        assert root.tag.endswith("svg"), name
        links = re.findall(r'href="([^"]*)"', svg)
        assert all(link.startswith(("#", "data:")) for link in links), name


def test_pictures_say_what_they_show(drawn: dict[str, str]) -> None:
    assert "uncalibrated" in drawn["centres"]
    assert "uncalibrated" not in drawn["centres alone"]
    assert "rejected" in drawn["shots"]
    assert "limit 0.1 mm" in drawn["shots"]
    assert "A-B" in drawn["lengths"]


def test_the_same_data_give_the_same_picture(drawn: dict[str, str]) -> None:
    again = pictures()
    assert again["shots"] == drawn["shots"]
    assert again["centres"] == drawn["centres"]


def test_ids_of_different_pictures_do_not_clash(drawn: dict[str, str]) -> None:
    clips = [set(re.findall(r'<clipPath id="([^"]+)"', drawn[name])) for name in ("centres", "shots", "coverage", "lengths")]
    assert sum(map(len, clips)) == len(set().union(*clips))
