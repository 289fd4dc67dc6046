"""The recording of a fused cloud: it is there whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.errors import FileError
from measure.fuse import VoxelGrid
from measure.viewer_cloud import write_cloud_recording


@pytest.mark.parametrize("full", [True, False])
def test_a_cloud_becomes_a_recording(tmp_path: Path, full: bool) -> None:
    grid = VoxelGrid(0.5, full=full)
    grid.add(np.random.default_rng(1).normal(0, 5, (500, 3)))
    assert write_cloud_recording(tmp_path / "cloud.rrd", grid.fused(), title="a cloud") == tmp_path / "cloud.rrd"
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.rrd"]
    assert (tmp_path / "cloud.rrd").read_bytes()[:4] == b"RRF2"
    from rerun.chunk import RrdReader

    paths = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "cloud.rrd")).stream()}
    # a cloud of means alone has nothing to be coloured by, and is shown all the same
    assert {"/legend", "/base/spread" if full else "/base/points"} <= paths


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such folder"):
        write_cloud_recording(tmp_path / "none" / "cloud.rrd", VoxelGrid(0.5).fused(), title="a cloud")
