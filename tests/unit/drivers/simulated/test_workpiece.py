"""The built-in workpiece: closed, outward, of the volume its drawing says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drivers.errors import FileError
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import transform_rows
from drivers.simulated.truth import Truth, WorkpieceTruth
from drivers.simulated.workpiece import BLOCK_SIZE_MM, BORE_RADII_MM, stepped_block
from drivers.simulated.workpiece_machined import MachinedPart
from tests.support.simulated import paper_model


def test_every_solid_is_closed_and_faces_outward() -> None:
    vertices, faces = stepped_block()
    solids = trimesh.Trimesh(vertices, faces, process=False).split(only_watertight=True)
    assert len(solids) == 4
    assert all(solid.is_watertight and solid.is_winding_consistent and solid.volume > 0 for solid in solids)


def test_volume_is_that_of_the_drawing() -> None:
    vertices, faces = stepped_block(segments=512)
    bores = sum(np.pi * radius**2 * 40 for radius in BORE_RADII_MM)
    expected = 120 * 100 * 40 - bores + 40 * 100 * 60 + np.pi * 15**2 * 15
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(expected, rel=1e-4)


def test_the_machined_part_is_closed_solids_of_the_volumes_of_its_drawing() -> None:
    vertices, faces = MachinedPart().mesh(segments=720)
    solids = trimesh.Trimesh(vertices, faces, process=False).split(only_watertight=True)
    assert all(solid.is_winding_consistent for solid in solids)
    sink = np.pi * 5 / 3 * (15**2 + 15 * 10 + 10**2)
    expected = [45 * 100 * 40 - np.pi * 10**2 * 35 - sink, 45 * 100 * 40 - np.pi * 15**2 * 40, 35 * 100 * 40 - (np.pi * 6**2 + 28 * 12) * 40]
    expected += [35 * 100 * 58, np.pi * 11**2 * 12]
    assert [solid.volume for solid in solids] == pytest.approx(expected, rel=1e-4)


def test_the_machined_part_can_be_simulated_by_name() -> None:
    mesh = SimulatedCell(Truth(workpiece=WorkpieceTruth(transform_rows(np.eye(4)), mesh="machined_part")), paper_model()).mesh()
    assert mesh is not None
    np.testing.assert_allclose(np.ptp(mesh.vertices_in_part_mm, axis=0), [160, 100, 70])


def test_size_and_origin() -> None:
    vertices, _ = stepped_block()
    np.testing.assert_allclose(np.ptp(vertices, axis=0), BLOCK_SIZE_MM)
    np.testing.assert_allclose(vertices.min(axis=0), [-80, -50, 0])


def test_a_mesh_file_is_read_beside_the_truth_and_a_broken_one_told(tmp_path: Path) -> None:
    vertices, faces = stepped_block()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "part.stl")
    truth = Truth(workpiece=WorkpieceTruth(transform_rows(np.eye(4)), mesh="part.stl"))
    mesh = SimulatedCell(truth, paper_model(), folder=tmp_path).mesh()
    assert mesh is not None
    np.testing.assert_allclose(np.ptp(mesh.vertices_in_part_mm, axis=0), BLOCK_SIZE_MM, rtol=1e-6)
    (tmp_path / "broken.stl").write_text("solid nothing")
    for name in ("missing.stl", "broken.stl", "broken.xyzzy"):
        wrong = Truth(workpiece=WorkpieceTruth(transform_rows(np.eye(4)), mesh=name))
        with pytest.raises(FileError, match="mesh"):
            SimulatedCell(wrong, paper_model(), folder=tmp_path).mesh()
