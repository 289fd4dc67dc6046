"""Stitching: the scans of a session, one at a time, through a calibration into one cloud in the robot base."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from acquire.cell import cell_of_session
from drivers.errors import DataError, SettingsError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, Shot, read_scan
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.fuse import DEFAULT_MEMORY_MB, FusedCloud, VoxelGrid
from measure.placing import check_fits
from measure.stitching.outputs import CloudLabel, check_suffix, read_fused, write_cloud
from measure.stitching.refine import Refinement, ScanSurface, refine, require_registration, surface_of
from measure.stitching.scan import DEFAULT_CLEANING, NO_CLEANING, Cleaning, StitchingSystem, prepare_scan, unit_variance_mm2

Progress = Callable[[int, int], None]
"""Called after each scan with the number done and the number of all."""


@dataclass(frozen=True, slots=True)
class StitchSettings:
    """How to stitch."""

    voxel_mm: float = 0.5
    cleaning: Cleaning = DEFAULT_CLEANING
    min_count: int = 1
    """Voxels with fewer points are left out."""
    full: bool = True
    """Normals, spread and uncertainty too; otherwise means, counts and weights."""
    memory_mb: float = DEFAULT_MEMORY_MB
    """Budget of the voxel table; beyond it the table goes to disk, beside the output."""
    n_threads: int | None = None
    """Scans worked on at a time; as many as there are processors if None. It changes no bit of the result."""
    refine: bool = False
    """Also register the scans to each other, and write that cloud beside the unrefined one."""


@dataclass(frozen=True, slots=True)
class ScanCounts:
    """What became of the points of some scans."""

    n_valid: int = 0
    n_edge: int = 0
    n_grazing: int = 0
    n_speck: int = 0
    n_outside: int = 0
    empty_shots: tuple[int, ...] = ()
    """Indices of shots without a valid point."""

    def __add__(self, other: ScanCounts) -> ScanCounts:
        """Of both."""
        return ScanCounts(
            self.n_valid + other.n_valid,
            self.n_edge + other.n_edge,
            self.n_grazing + other.n_grazing,
            self.n_speck + other.n_speck,
            self.n_outside + other.n_outside,
            self.empty_shots + other.empty_shots,
        )


@dataclass(frozen=True, slots=True, eq=False)
class StitchResult:
    """What became of a session."""

    out: Path
    n_scans: int
    counts: ScanCounts
    n_points: int
    """Points written, one per voxel."""
    n_tiles: int
    """How often the voxel table went to disk."""
    voxel_mm: float
    calibration_id: str
    session_digest: str
    seconds: float
    marks: tuple[str, ...] = ()
    """How robot and camera differ from those that were calibrated, where the cell file lets that pass."""
    refinement: Refinement | None = None
    refined_out: Path | None = None
    """The refined cloud, where one was asked for and any scans overlap."""

    @property
    def n_points_in(self) -> int:
        """Valid points read."""
        return self.counts.n_valid

    @property
    def n_edge_points(self) -> int:
        """Valid points dropped as flying pixels."""
        return self.counts.n_edge

    @property
    def points_per_second(self) -> float:
        """Valid points read per second, all steps included."""
        return self.n_points_in / self.seconds if self.seconds > 0 else 0.0

    @property
    def cloud(self) -> FusedCloud:
        """The cloud, read back from a PLY file; FileError where it has gone, or is of another format."""
        return read_fused(self.out)

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints."""
        return {
            "n_points": self.n_points,
            "n_points_in": self.n_points_in,
            "out": str(self.out),
            "seconds": self.seconds,
            "points_per_second": self.points_per_second,
            "n_scans": self.n_scans,
            "n_edge_points": self.counts.n_edge,
            "n_grazing_points": self.counts.n_grazing,
            "n_speck_points": self.counts.n_speck,
            "n_outside": self.counts.n_outside,
            "empty_shots": list(self.counts.empty_shots),
            "n_tiles": self.n_tiles,
            "voxel_mm": self.voxel_mm,
            "calibration": self.calibration_id,
            "session": self.session_digest,
            "marks": list(self.marks),
            "refinement": None if self.refinement is None else self.refinement.to_json_dict(),
            "refined_out": None if self.refined_out is None else str(self.refined_out),
        }


class Stitcher:
    """Scans in, one cloud out: for those who have the scans before the session is closed, such as an in-line measurement."""

    def __init__(
        self,
        calibration: StitchingSystem,
        session: Session,
        settings: StitchSettings,
        *,
        spill_folder: Path | None = None,
        motions: Mapping[int, FloatArray] | None = None,
    ) -> None:
        """An empty cloud.

        Args:
            calibration: what moves points from the camera to the base.
            session: that the shots belong to.
            settings: how to stitch.
            spill_folder: where the table goes beyond its memory.
            motions: (4, 4) by index of the shot, applied in the base after the calibration: a refinement's.

        Raises:
            SettingsError: a voxel size or budget that is no positive number.
        """
        self._calibration = calibration
        self._session = session
        self._cleaning = settings.cleaning
        self._collects = settings.refine
        self._motions: Mapping[int, FloatArray] = motions or {}
        self.surfaces: list[ScanSurface] = []
        """What registration needs of each scan, where it was asked for."""
        unit = unit_variance_mm2(calibration.noise)
        self.grid = VoxelGrid(settings.voxel_mm, full=settings.full, unit_variance_mm2=unit, memory_mb=settings.memory_mb, spill_folder=spill_folder)

    def add(self, shot: Shot, cloud: PointCloud) -> ScanCounts:
        """Fuse one scan; from any thread, in any order.

        Raises:
            DataError: the shot lacks the pose that the calibration needs, its scan is in another unit, or a voxel is overfull.
        """
        full = self.grid.full
        scan = prepare_scan(self._calibration, self._session, shot, cloud, self._cleaning, full=full)
        if self._collects:
            self.surfaces.append(surface_of(shot, cloud.points_mm, scan))
        points = scan.points_in_base_mm
        if shot.index in self._motions:
            # normals stay: they turn by less than a thousandth
            points = se3.apply(self._motions[shot.index], points.reshape(-1, 3)).reshape(points.shape)
        added = self.grid.add(points, weights=scan.weights, normals=scan.normals if full else None, variances=scan.variances if full else None)
        empty = () if scan.n_valid else (shot.index,)
        return ScanCounts(scan.n_valid, scan.n_edge, scan.n_grazing, scan.n_speck, added.n_outside, empty)


def stitch(
    calibration: StitchingSystem,
    session: Session,
    out: str | Path,
    voxel_mm: float = 0.5,
    *,
    clean_edges: bool = True,
    min_count: int = 1,
    settings: StitchSettings | None = None,
    on_progress: Progress | None = None,
) -> StitchResult:
    """Fuse every good scan of a session into one cloud in the base and write it.

    The file (PLY; PCD, E57 or LAZ by its ending) holds for each point the mean in mm, normal, count, weight, number of
    scans, spread and standard uncertainty along the normal; it names unit, frame, calibration and session. It appears
    whole or not at all. The result does not depend on the order of the scans nor on the number of threads.

    Args:
        calibration: what moves points from the camera to the base.
        session: with at least one good scan; each scan is used once, however many lines of shots.jsonl name it.
        out: the file.
        voxel_mm: edge of the voxels.
        clean_edges: drop flying pixels, grazing surfaces and specks of organised scans first.
        min_count: leave out voxels with fewer points.
        settings: all of these and more; wins over the former three.
        on_progress: told after each scan.

    Raises:
        DataError: no good scan, a shot without the pose the calibration needs, no point left.
        FileError: a scan is missing, broken or changed; the folder of `out` is not writable.
        SettingsError: a voxel size that is no positive number, an ending that is not known or whose library is missing.
    """
    began = time.perf_counter()
    chosen = settings or StitchSettings(voxel_mm, DEFAULT_CLEANING if clean_edges else NO_CLEANING, min_count)
    target = Path(out)
    check_suffix(target)
    if chosen.refine:
        require_registration()
    stitcher = Stitcher(calibration, session, chosen, spill_folder=target.parent)
    marks = check_fits(calibration, session)
    shots = scans_once(session)
    counts = ScanCounts()
    for done, added in enumerate(fused_scans(stitcher.add, session, shots, chosen.n_threads), start=1):
        counts += added
        if on_progress is not None:
            on_progress(done, len(shots))
    n_points = stitcher.grid.n_fused(min_count=chosen.min_count)
    require_points(n_points, session, counts)
    label = cloud_label(calibration, session, chosen, len(shots))
    write_cloud(target, stitcher.grid.pieces(min_count=chosen.min_count), n_points, label)
    refinement, refined_out = _refined(calibration, session, chosen, stitcher.surfaces, target, shots) if chosen.refine else (None, None)
    return StitchResult(
        out=target,
        n_scans=len(shots),
        counts=counts,
        n_points=n_points,
        n_tiles=stitcher.grid.n_tiles,
        voxel_mm=stitcher.grid.voxel_mm,
        calibration_id=calibration.id,
        session_digest=session.digest,
        seconds=time.perf_counter() - began,
        marks=marks,
        refinement=refinement,
        refined_out=refined_out,
    )


def _refined(
    calibration: StitchingSystem,
    session: Session,
    settings: StitchSettings,
    surfaces: Sequence[ScanSurface],
    unrefined: Path,
    shots: Sequence[Shot],
) -> tuple[Refinement, Path | None]:
    """Register the scans and write the cloud that they make then, beside the unrefined one."""
    found = refine(calibration, surfaces)
    if not found.n_pairs:
        return found, None
    stitcher = Stitcher(calibration, session, replace(settings, refine=False), spill_folder=unrefined.parent, motions=found.motions)
    for _ in fused_scans(stitcher.add, session, shots, settings.n_threads):
        pass
    out = unrefined.with_name(f"{unrefined.stem}.refined{unrefined.suffix}")
    label = cloud_label(calibration, session, settings, len(shots), "refined by registration")
    write_cloud(out, stitcher.grid.pieces(min_count=settings.min_count), stitcher.grid.n_fused(min_count=settings.min_count), label)
    return found, out


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


def cloud_label(calibration: StitchingSystem, session: Session, settings: StitchSettings, n_scans: int, *further: str) -> CloudLabel:
    """What the file says of a cloud."""
    cell = cell_of_session(session)
    comments = (
        "unit mm",
        "frame base",
        f"calibration {calibration.id}",
        f"session {session.digest}",
        f"drivers {cell.robot.driver} {cell.camera.driver}",
        f"voxel_mm {settings.voxel_mm:g}",
        f"scans {n_scans}",
        "uncertainty is standard (k = 1), mm, along the normal",
        *further,
    )
    return CloudLabel(comments, f"base frame, calibration {calibration.id[:12]}")


def n_workers(n_threads: int | None) -> int:
    """Threads to use: those asked for, or one a processor that this process may use.

    Raises:
        SettingsError: less than one.
    """
    if n_threads is not None and n_threads < 1:
        raise SettingsError(f"{n_threads} threads", where="n_threads", remedy="Use one or more.")
    return n_threads or len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1))


def fused_scans(
    add: Callable[[Shot, PointCloud], ScanCounts], session: Session, shots: Sequence[Shot], n_threads: int | None
) -> Iterator[ScanCounts]:
    """What became of each scan, in order; at most two a thread are in hand, so that memory does not grow with the scans."""
    n = n_workers(n_threads)

    def work(shot: Shot) -> ScanCounts:
        return add(shot, read_scan(session, shot))

    with ThreadPoolExecutor(max_workers=n, thread_name_prefix="stitch") as pool:
        waiting: list[Future[ScanCounts]] = []
        try:
            for shot in shots:
                waiting.append(pool.submit(work, shot))
                if len(waiting) >= 2 * n:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()


def require_points(n_points: int, session: Session, counts: ScanCounts) -> None:
    """Refuse a cloud of which nothing is left.

    Raises:
        DataError: says where the points went.
    """
    if n_points == 0:
        dropped = f"{counts.n_edge} at depth edges, {counts.n_grazing} seen too grazing, {counts.n_speck} in specks, {counts.n_outside} out of reach"
        raise DataError(
            f"no point is left of {counts.n_valid} valid ones ({dropped})",
            file=session.folder,
            remedy="Look at the scans; switch the cleaning off; ask for fewer points a voxel.",
        )
