"""Stitching: the scans of a session, one at a time, through a calibration into one cloud in the robot base."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DataError
from drivers.files.ply import PointCloud, write_ply
from drivers.files.session import Session, Shot, read_scan
from measure.fuse import FusedCloud, VoxelGrid, flying_pixel_mask
from measure.placing import MeasuringSystem, check_fits, points_of_shot_in_base_mm

Progress = Callable[[int, int], None]
"""Called after each scan with the number done and the number of all."""

_SMALLEST_SCAN_MM = 20.0
_PIECE = 1 << 15


@dataclass(frozen=True, slots=True, eq=False)
class StitchResult:
    """What became of a session."""

    out: Path
    n_scans: int
    n_points_in: int
    """Valid points read."""
    n_points: int
    """Points written, one per voxel."""
    n_edge_points: int
    """Valid points dropped as flying pixels."""
    n_outside: int
    """Valid points dropped because no robot reaches that far."""
    voxel_mm: float
    calibration_id: str
    session_digest: str
    seconds: float
    cloud: FusedCloud

    @property
    def points_per_second(self) -> float:
        """Valid points read per second, all steps included."""
        return self.n_points_in / self.seconds if self.seconds > 0 else 0.0

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints."""
        return {
            "n_points": self.n_points,
            "n_points_in": self.n_points_in,
            "out": str(self.out),
            "seconds": self.seconds,
            "points_per_second": self.points_per_second,
            "n_scans": self.n_scans,
            "n_edge_points": self.n_edge_points,
            "n_outside": self.n_outside,
            "voxel_mm": self.voxel_mm,
            "calibration": self.calibration_id,
            "session": self.session_digest,
        }


def stitch(
    calibration: MeasuringSystem,
    session: Session,
    out: str | Path,
    voxel_mm: float = 0.5,
    *,
    clean_edges: bool = True,
    min_count: int = 1,
    on_progress: Progress | None = None,
) -> StitchResult:
    """Fuse every good scan of a session into one cloud in the base and write it as PLY.

    The file holds float x y z in mm, `count` (points of the voxel) and `spread` (their rms distance from the mean, mm)
    per point; its comments name unit, frame, calibration and session. It appears whole or not at all. The result does
    not depend on the order of the scans.

    Args:
        calibration: what moves points from the camera to the base.
        session: with at least one good scan; each scan is used once, however many lines of shots.jsonl name it.
        out: the PLY file.
        voxel_mm: edge of the voxels.
        clean_edges: drop flying pixels of organised scans first (`flying_pixel_mask`).
        min_count: leave out voxels with fewer points.
        on_progress: told after each scan.

    Raises:
        DataError: no good scan, a shot without the pose the calibration needs, no point left.
        FileError: a scan is missing, broken or changed; the folder of `out` is not writable.
        SettingsError: a voxel size that is no positive number.
    """
    began = time.perf_counter()
    grid = VoxelGrid(voxel_mm)
    check_fits(calibration, session)
    shots = scans_once(session)
    n_valid = n_edge = n_outside = 0
    for done, (shot, cloud) in enumerate(_read_ahead(session, shots), start=1):
        valid = np.asarray(np.isfinite(cloud.xyz_mm).all(axis=-1))
        _require_mm(cloud, valid, session, shot)
        kept = _without_edges(cloud, valid) if clean_edges else valid
        n_outside += _fuse(grid, calibration, session, shot, cloud.xyz_mm[kept])
        n_valid += int(valid.sum())
        n_edge += int(valid.sum() - kept.sum())
        if on_progress is not None:
            on_progress(done, len(shots))
    fused = grid.fused(min_count=min_count)
    _require_points(fused, session, n_valid, n_edge)
    _write(Path(out), fused, calibration, session, len(shots))
    return StitchResult(
        out=Path(out),
        n_scans=len(shots),
        n_points_in=n_valid,
        n_points=len(fused.points_mm),
        n_edge_points=n_edge,
        n_outside=n_outside,
        voxel_mm=grid.voxel_mm,
        calibration_id=calibration.id,
        session_digest=session.digest,
        seconds=time.perf_counter() - began,
        cloud=fused,
    )


def scans_once(session: Session) -> tuple[Shot, ...]:
    """The good shots of a session that have a scan, one per scan: two spheres in one scan are two lines with the same.

    Raises:
        DataError: there is none.
    """
    first_of_scan: dict[str, Shot] = {}
    for shot in session.shots:
        if shot.status == "ok" and shot.scan is not None:
            first_of_scan.setdefault(shot.scan, shot)
    if not first_of_scan:
        raise DataError("the session has no good scan", file=session.folder, remedy="Capture again, or resume the capture.")
    return tuple(first_of_scan.values())


def _read_ahead(session: Session, shots: Sequence[Shot]) -> Iterator[tuple[Shot, PointCloud]]:
    """Scans in order, the next one being read and checked while this one is worked on."""
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read_scan") as reader:
        coming = reader.submit(read_scan, session, shots[0])
        for shot, following in zip(shots, [*shots[1:], None], strict=True):
            cloud = coming.result()
            if following is not None:
                coming = reader.submit(read_scan, session, following)
            yield shot, cloud


def _fuse(grid: VoxelGrid, calibration: MeasuringSystem, session: Session, shot: Shot, points_in_camera_mm: NDArray[np.float32]) -> int:
    """Move points (n, 3) to the base and add them; the number that fell outside the grid's range.

    In pieces that stay in the processor's cache: a whole scan at once takes twice as long.
    """
    pieces = range(0, len(points_in_camera_mm), _PIECE)
    clouds = (points_of_shot_in_base_mm(calibration, session, shot, points_in_camera_mm[i : i + _PIECE].astype(np.float64)) for i in pieces)
    return sum(grid.add(cloud).n_outside for cloud in clouds)


def _without_edges(cloud: PointCloud, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    # a scan without a grid has no neighbours to judge by
    if cloud.xyz_mm.ndim != 3 or min(cloud.xyz_mm.shape[:2]) < 3:
        return valid
    return valid & flying_pixel_mask(cloud.xyz_mm)


def _require_mm(cloud: PointCloud, valid: NDArray[np.bool_], session: Session, shot: Shot) -> None:
    # a look at some points clears nearly every scan
    if any(valid[part].any() and float(np.abs(cloud.xyz_mm[part][valid[part]]).max()) >= _SMALLEST_SCAN_MM for part in (np.s_[::97], np.s_[:])):
        return
    if valid.any():
        raise DataError(
            f"the whole scan of shot {shot.index} lies within {_SMALLEST_SCAN_MM:g} mm of the camera",
            file=session.folder / str(shot.scan),
            remedy="It is probably in metres: scans are in mm.",
        )


def _require_points(fused: FusedCloud, session: Session, n_valid: int, n_edge: int) -> None:
    if len(fused.points_mm) == 0:
        raise DataError(
            f"no point is left of {n_valid} valid ones ({n_edge} dropped at depth edges)",
            file=session.folder,
            remedy="Look at the scans; switch the edge cleaning off; ask for fewer points a voxel.",
        )


def _write(out: Path, fused: FusedCloud, calibration: MeasuringSystem, session: Session, n_scans: int) -> None:
    comments = (
        "unit mm",
        "frame base",
        f"calibration {calibration.id}",
        f"session {session.digest}",
        f"voxel_mm {fused.voxel_mm:g}",
        f"scans {n_scans}",
    )
    properties = {"count": fused.count.astype(np.uint32), "spread": fused.spread_mm.astype(np.float32)}
    write_ply(out, fused.points_mm.astype(np.float32), properties=properties, comments=comments)
