"""A part from its scans to its verdict in one go: the scans are fused as they come, and the inspection follows in memory.

The in-line case: while the robot still moves, every scan is corrected, cleaned and fused (`add`); after the last trigger
only that scan, the fit of the features and the verdict are left. Cloud and verdict are those of `stitch` and `inspect`
one after the other, to the last digit.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.files.ply import PointCloud
from drivers.files.session import Session, Shot
from measure.fuse import VoxelGrid
from measure.gauge.correlation import Correlation
from measure.inspecting.cloud import FEWEST_POINTS, MeasuredCloud, cloud_of
from measure.inspecting.inspection import inspect_cloud
from measure.inspecting.nominal import Nominal
from measure.inspecting.region import region_of
from measure.inspecting.result import Inspection
from measure.inspecting.spec import InspectionSpec
from measure.inspecting.views import View, field_of, view_of
from measure.placing import check_fits
from measure.stitch import Progress, ScanCounts, Stitcher, StitchResult, StitchSettings, cloud_label, fused_scans, require_points, scans_once
from measure.stitching.outputs import CloudLabel, as_written, write_cloud
from measure.stitching.scan import StitchingSystem

CLOUD_FILE = "cloud.ply"


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What a part is compared with."""

    nominal: Nominal
    spec: InspectionSpec
    correlation: Correlation | None = None
    """Offsets to a reference gauge."""
    judge_corrected: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPart:
    """A part's cloud, not written yet, and its verdict."""

    inspection: Inspection
    stitched: StitchResult
    grid: VoxelGrid
    min_count: int
    label: CloudLabel

    def cloud(self) -> MeasuredCloud:
        """All of it, as `load_cloud` reads what `write_cloud` writes: for a map of deviations."""
        return cloud_of(as_written(self.grid.fused(min_count=self.min_count), self.label), self.stitched.out)

    def write_cloud(self, folder: Path) -> None:
        """Write the cloud into a folder.

        Raises:
            FileError: it cannot be written.
        """
        write_cloud(folder / CLOUD_FILE, self.grid.pieces(min_count=self.min_count), self.stitched.n_points, self.label)


class PartInProgress:
    """Scans in, from any thread and in any order; then the verdict."""

    def __init__(self, calibration: StitchingSystem, settings: StitchSettings | None = None, *, spill_folder: Path | None = None) -> None:
        """Nothing seen yet.

        Args:
            calibration: what the part is measured with.
            settings: how its scans are stitched.
            spill_folder: where the table of voxels goes beyond its memory.
        """
        self._calibration = calibration
        self._settings = settings or StitchSettings()
        self._spill_folder = spill_folder
        self._lock = threading.Lock()
        self._stitcher: Stitcher | None = None
        self._views: dict[int, View] = {}
        self._counts: dict[int, ScanCounts] = {}
        self._marks: tuple[str, ...] = ()

    def add(self, session: Session, shot: Shot, cloud: PointCloud) -> ScanCounts:
        """Fuse one scan of a session that may still be written.

        Raises:
            DataError: the session does not fit the calibration, the shot lacks its pose, or its scan is in another unit.
            FileError: the session's cell is broken.
        """
        with self._lock:
            if self._stitcher is None:
                self._marks = check_fits(self._calibration, session)
                self._stitcher = Stitcher(self._calibration, session, self._settings, spill_folder=self._spill_folder)
        counts = self._stitcher.add(shot, cloud)
        self._views[shot.index], self._counts[shot.index] = view_of(shot, cloud), counts
        return counts

    def catch_up(self, session: Session, on_progress: Progress | None = None) -> None:
        """See that just the good scans of a session are in: others that were fused make it begin anew, missing ones are read.

        Args:
            session: as it lies on disk now.
            on_progress: told after each scan that is read.

        Raises:
            DataError: no good scan, or as `add`.
            FileError: a scan is missing, broken or changed.
        """
        good = scans_once(session)
        if set(self._counts) - {shot.index for shot in good}:
            # sums hold no single scan to take out again
            self._stitcher, self._views, self._counts = None, {}, {}
        self._marks = check_fits(self._calibration, session)
        missing = [shot for shot in good if shot.index not in self._counts]

        def add(shot: Shot, cloud: PointCloud) -> ScanCounts:
            return self.add(session, shot, cloud)

        for done, _ in enumerate(fused_scans(add, session, missing, self._settings.n_threads), start=1):
            if on_progress is not None:
                on_progress(done, len(missing))

    def judged(self, session: Session, drawing: Drawing, folder: Path, *, began: float, on_progress: Progress | None = None) -> MeasuredPart:
        """The verdict on all good scans of a session; nothing is written, and no map is made that no check asks for.

        Args:
            session: as it lies on disk now.
            drawing: what the part is compared with.
            folder: where the cloud will be written.
            began: `time.perf_counter()` from which the seconds to the verdict are counted.
            on_progress: told after each scan that had to be read.

        Raises:
            DataError: as `catch_up`; no point is left, nothing of the cloud lies on the part, or it cannot be aligned.
            FileError: as `catch_up`; a check asks for what its feature does not have.
            SettingsError: the datums fix no frame.
        """
        self.catch_up(session, on_progress)
        if self._stitcher is None:  # catch_up raises where there is no scan
            raise RuntimeError
        grid, settings = self._stitcher.grid, self._settings
        counts = sum((self._counts[index] for index in sorted(self._counts)), ScanCounts())
        n_points = grid.n_fused(min_count=settings.min_count)
        require_points(n_points, session, counts)
        stitched = StitchResult(
            out=folder / CLOUD_FILE,
            n_scans=len(self._counts),
            counts=counts,
            n_points=n_points,
            n_tiles=grid.n_tiles,
            voxel_mm=grid.voxel_mm,
            calibration_id=self._calibration.id,
            session_digest=session.digest,
            seconds=time.perf_counter() - began,
            marks=self._marks,
        )
        label = cloud_label(self._calibration, session, settings, len(self._counts))
        part = MeasuredPart(self._inspected_near(drawing, grid, label, stitched), stitched, grid, settings.min_count, label)
        return replace(part, inspection=replace(part.inspection, seconds_to_verdict=time.perf_counter() - began))

    def _inspected_near(self, drawing: Drawing, grid: VoxelGrid, label: CloudLabel, stitched: StitchResult) -> Inspection:
        """Judged by the points that the inspection can look at; by all where the part turns out to stand elsewhere."""
        region = region_of(drawing.spec, drawing.nominal)
        if region is not None:
            fused = grid.fused(min_count=self._settings.min_count, box_mm=region.in_base_mm)
            if len(fused.count) >= FEWEST_POINTS:
                found = self._inspected(drawing, cloud_of(as_written(fused, label), stitched.out))
                if region.holds(found.alignment.part_from_base):
                    return _of_whole_cloud(found, stitched.n_points)
        return self._inspected(drawing, cloud_of(as_written(grid.fused(min_count=self._settings.min_count), label), stitched.out))

    def _inspected(self, drawing: Drawing, measured: MeasuredCloud) -> Inspection:
        views = [self._views[index] for index in sorted(self._views)]
        return inspect_cloud(
            measured,
            drawing.nominal,
            drawing.spec,
            field_source=field_of(self._calibration, views),
            with_map=False,
            correlation=drawing.correlation,
            judge_corrected=drawing.judge_corrected,
        )


def _of_whole_cloud(found: Inspection, n_points: int) -> Inspection:
    """With the counts of the cloud that its points come from."""
    deviations, n_beside = found.deviations, n_points - found.n_points
    if deviations is not None:
        deviations = replace(deviations, n_left_out=deviations.n_left_out + n_beside)
    return replace(found, n_points=n_points, deviations=deviations)


def measure_part(
    calibration: StitchingSystem,
    session: Session,
    drawing: Drawing,
    folder: Path,
    settings: StitchSettings | None = None,
    *,
    spill_folder: Path | None = None,
    on_progress: Progress | None = None,
) -> MeasuredPart:
    """A session on disk to its verdict; `folder` is where its results will be, for the rest see `PartInProgress`.

    Raises:
        DataError: as `PartInProgress.judged`.
        FileError: as `PartInProgress.judged`.
        SettingsError: as `PartInProgress.judged`.
    """
    began = time.perf_counter()
    part = PartInProgress(calibration, settings, spill_folder=spill_folder)
    return part.judged(session, drawing, folder, began=began, on_progress=on_progress)
