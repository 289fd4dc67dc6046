"""The decoder: every coding of one scene gives the same points, within its quantisation; harvesters' table as the oracle of codes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.cameras.genicam.decode import Part, decode
from drivers.cameras.genicam.pfnc import FORMATS, name_of
from drivers.cameras.genicam.scan3d import Coordinate, Pinhole, Scan3d, problems, read_scan3d
from drivers.cameras.points import parse_axes
from drivers.errors import CameraMisconfigured, IncompleteFrame

HEIGHT, WIDTH = 5, 7
PINHOLE = Pinhole(600.0, 3.2, 2.1, 1.01)


def scene() -> NDArray[np.float64]:
    """Points (5, 7, 3) in mm on the lines of sight of PINHOLE."""
    rng = np.random.default_rng(7)
    z = rng.uniform(300, 400, (HEIGHT, WIDTH))
    x = (np.arange(WIDTH) - 3.2) / 600 * z
    y = (np.arange(HEIGHT) - 2.1)[:, None] / (600 * 1.01) * z
    return np.stack([x, y, z], axis=-1)


def part(pixel_format: str, values: NDArray[np.generic]) -> Part:
    """A part as it comes from a buffer."""
    return Part(pixel_format, WIDTH, HEIGHT, np.frombuffer(np.ascontiguousarray(values).tobytes(), dtype=np.uint8))


SCALE, OFFSET = 0.01, -200.0
CODED = Coordinate(SCALE, OFFSET, invalid=65535.0)
ZERO_INVALID = Coordinate(invalid=0.0)


def as_floats(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """A hole in the middle, marked by zeros."""
    floats = points.astype("<f4")
    floats[2, 3] = 0.0
    return floats


def as_words(points: NDArray[np.float64]) -> NDArray[np.uint16]:
    """A hole in the middle, marked by 65535 in one axis."""
    words = np.rint((points - OFFSET) / SCALE).astype("<u2")
    words[2, 3, 2] = 65535
    return words


def codings() -> dict[str, tuple[list[Part], Scan3d, float]]:
    """Name -> parts, description, largest error in mm."""
    floats, words = as_floats(scene()), as_words(scene())
    float_scan, word_scan = Scan3d(a=ZERO_INVALID, b=ZERO_INVALID, c=ZERO_INVALID), Scan3d(a=CODED, b=CODED, c=CODED)
    depth = Scan3d(output_mode="RectifiedC", pinhole=PINHOLE, c=ZERO_INVALID)
    inches = Scan3d(unit="Inch", a=Coordinate(invalid=0.0), b=Coordinate(invalid=0.0), c=Coordinate(invalid=0.0))
    return {
        "ABC32f": ([part("Coord3D_ABC32f", floats)], float_scan, 3e-5),
        "ABC32f planar": ([part("Coord3D_ABC32f_Planar", np.moveaxis(floats, -1, 0))], float_scan, 3e-5),
        "A32f B32f C32f among others": (
            [part("RGBa8", np.zeros((HEIGHT, WIDTH, 4), np.uint8)), *(part(f"Coord3D_{axis}32f", floats[..., i]) for i, axis in enumerate("ABC"))],
            float_scan,
            3e-5,
        ),
        "ABC16": ([part("Coord3D_ABC16", words)], word_scan, SCALE * 0.51),
        "ABC16 planar": ([part("Coord3D_ABC16_Planar", np.moveaxis(words, -1, 0))], word_scan, SCALE * 0.51),
        "A16 B16 C16": ([part(f"Coord3D_{axis}16", words[..., i]) for i, axis in enumerate("CBA"[::-1])][::-1], word_scan, SCALE * 0.51),
        "C32f with lines of sight": ([part("Coord3D_C32f", floats[..., 2])], depth, 4e-5),
        "C16 with lines of sight": (
            [part("Coord3D_C16", words[..., 2])],
            Scan3d(output_mode="ProjectedC", pinhole=PINHOLE, c=CODED),
            SCALE * 0.51,
        ),
        "inches": ([part("Coord3D_ABC32f", as_floats(scene() / 25.4))], inches, 4e-5),
    }


@pytest.mark.parametrize("name", codings())
def test_every_coding_gives_the_scene_and_its_hole(name: str) -> None:
    parts, scan3d, tolerance_mm = codings()[name]
    assert not problems(scan3d)
    decoded = decode(parts, scan3d)
    assert decoded.xyz_mm.dtype == np.float32
    assert decoded.xyz_mm.flags.c_contiguous
    assert np.isnan(decoded.xyz_mm[2, 3]).all()
    decoded.xyz_mm[2, 3] = scene()[2, 3]
    assert np.abs(decoded.xyz_mm - scene()).max() < tolerance_mm


def test_the_points_are_owned() -> None:
    data = np.frombuffer(bytearray(as_floats(scene()).tobytes()), dtype=np.uint8)
    decoded = decode([Part("Coord3D_ABC32f", WIDTH, HEIGHT, data)], Scan3d())
    before = decoded.xyz_mm.copy()
    data[:] = 0
    assert np.array_equal(decoded.xyz_mm, before, equal_nan=True)


def test_axes_of_the_camera_s_own() -> None:
    turned = scene() * np.array([1, -1, -1])
    decoded = decode([part("Coord3D_ABC32f", turned.astype("<f4"))], Scan3d(), parse_axes("graphics"))
    assert np.abs(decoded.xyz_mm - scene()).max() < 3e-5


def test_a_list_of_points_has_no_grid() -> None:
    decoded = decode([part("Coord3D_ABC32f", as_floats(scene()))], Scan3d(output_mode="CalibratedABC_PointCloud"))
    assert decoded.xyz_mm.shape == (1, 35, 3)


def test_row_padding_is_left_out() -> None:
    rows = as_floats(scene()).reshape(HEIGHT, -1).view(np.uint8)
    padded = np.hstack([rows, np.full((HEIGHT, 4), 255, np.uint8)]).ravel()
    for data in (padded, padded[:-4]):  # the last row's padding may be missing
        decoded = decode([Part("Coord3D_ABC32f", WIDTH, HEIGHT, data, row_padding=4)], Scan3d())
        assert np.abs(decoded.xyz_mm[0] - scene()[0]).max() < 3e-5
        assert np.abs(decoded.xyz_mm[4] - scene()[4]).max() < 3e-5


def test_brightness_and_confidence_come_along_at_their_size() -> None:
    grey, trust = np.full((HEIGHT, WIDTH), 1023, "<u2"), np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH)
    parts = [part("Coord3D_ABC32f", as_floats(scene())), part("Mono10", grey), part("Confidence8", trust)]
    decoded = decode(parts, Scan3d())
    assert decoded.intensity is not None
    assert np.all(decoded.intensity == 1.0)
    assert decoded.confidence is not None
    assert np.array_equal(decoded.confidence, trust)
    large = Part("Mono8", 2 * WIDTH, HEIGHT, np.zeros(2 * WIDTH * HEIGHT, np.uint8))
    assert decode([parts[0], large], Scan3d()).intensity is None


@pytest.mark.parametrize("names", [["Mono8"], [], ["Coord3D_A32f"], ["Coord3D_A32f", "Coord3D_C32f"], ["Coord3D_ABC12p"], ["0x12345678"]])
def test_frames_without_coordinates_are_told(names: list[str]) -> None:
    with pytest.raises(CameraMisconfigured, match="no coordinates that are read"):
        decode([part(name, np.zeros((HEIGHT, WIDTH), "<f4")) for name in names], Scan3d())


def test_depths_alone_without_lines_of_sight_are_refused() -> None:
    with pytest.raises(CameraMisconfigured, match="tells no lines of sight"):
        decode([part("Coord3D_C32f", scene()[..., 2].astype("<f4"))], Scan3d())


ABC = sorted(name for name in FORMATS if name.startswith("Coord3D_ABC"))


@given(st.sampled_from(ABC), st.integers(0, 40), st.integers(0, 40), st.binary(max_size=600))
def test_any_bytes_give_points_or_an_incomplete_frame(name: str, width: int, height: int, data: bytes) -> None:
    needed = width * height * FORMATS[name].n_bytes_per_pixel
    try:
        decoded = decode([Part(name, width, height, np.frombuffer(data, dtype=np.uint8))], Scan3d())
    except IncompleteFrame:
        assert len(data) < needed or needed == 0
    else:
        assert decoded.xyz_mm.shape == (height, width, 3)


def test_codes_and_names_are_those_of_the_convention() -> None:
    table = pytest.importorskip("harvesters.util._pfnc", reason="harvesters is not installed: pip install 'spherecal[genicam]'").symbolics
    for name, pixel_format in FORMATS.items():
        assert table[pixel_format.code] == name
        assert name_of(pixel_format.code) == name
        bits = (pixel_format.code >> 16) & 0xFF  # effective size of a pixel
        assert bits == 8 * pixel_format.n_bytes_per_pixel
    assert name_of(0x01080008) == "0x01080008"


class Features:
    """Features of a camera, scale and offset by the selected axis."""

    def __init__(self, **values: str) -> None:
        self.values = values
        self.selected = "CoordinateC"

    def get(self, name: str) -> str | None:
        return self.values.get(f"{name}[{self.selected[-1]}]") or self.values.get(name)

    def put(self, name: str, value: str) -> None:
        if name == "Scan3dCoordinateSelector":
            self.selected = value
        elif name not in self.values:
            msg = "no such feature"
            raise ValueError(msg)


def test_a_description_is_read_axis_by_axis() -> None:
    features = Features(
        Scan3dDistanceUnit="Inch",
        Scan3dCoordinateSelector="CoordinateC",
        Scan3dInvalidDataFlag="true",
        Scan3dFocalLength="600",
        Scan3dPrincipalPointU="0",
        Scan3dPrincipalPointV="2.5",
        **{f"Scan3dCoordinateScale[{axis}]": f"{i}.5" for i, axis in enumerate("ABC", start=1)},
        **{f"Scan3dCoordinateOffset[{axis}]": f"-{i}" for i, axis in enumerate("ABC", start=1)},
        **{f"Scan3dInvalidDataValue[{axis}]": f"{i}" for i, axis in enumerate("ABC", start=7)},
    )
    scan3d = read_scan3d(features.get, features.put)
    assert (scan3d.a, scan3d.b, scan3d.c) == (Coordinate(1.5, -1, 7), Coordinate(2.5, -2, 8), Coordinate(3.5, -3, 9))
    assert scan3d.unit_mm == 25.4
    assert scan3d.pinhole == Pinhole(600, 0, 2.5)
    assert read_scan3d(Features().get, Features().put) == Scan3d()


@pytest.mark.parametrize(
    ("scan3d", "said"),
    [
        (Scan3d(unit="Pixel"), "distance unit"),
        (Scan3d(coordinate_system="Spherical"), "Cartesian"),
        (Scan3d(reference="Transformed"), "a transform is active"),
        (Scan3d(output_mode="DisparityC"), "output mode"),
        (Scan3d(output_mode="UncalibratedC"), "output mode"),
        (Scan3d(output_mode="CalibratedC"), "no lines of sight"),
        (Scan3d(c=Coordinate(scale=0.0)), "scale"),
    ],
)
def test_what_would_spoil_a_calibration_is_told(scan3d: Scan3d, said: str) -> None:
    (problem,) = problems(scan3d)
    assert said in problem
    assert problem.endswith(".")
