"""Any camera whose own software exports its scans into a folder as PLY, PCD or NPZ.

`capture` notes what lies in the folder, triggers the camera, and takes the one file that appears and is whole. The
trigger is one of: nothing (somebody presses the button), a file that is written, or a command that is run. Where the
command takes `{path}`, the scan is tied to its trigger by its name, and no other file can be taken for it.
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

from drivers.cameras.arrivals import Arrived, Stamp, Watch, new_names, snapshot
from drivers.cameras.exports import brightness, frame_points
from drivers.cameras.folder_settings import FolderSettings
from drivers.cameras.frames import require_plausible, settings_digest
from drivers.cameras.points import UNITS_MM, parse_axes
from drivers.cameras.settings import parse_settings
from drivers.errors import CameraLost, CameraNotReached, CameraTimeout, FileError, InvalidFrame, StaleFrame
from drivers.files.disk import write_atomic
from drivers.protocols import CameraInfo, Frame3D
from drivers.registry import DriverContext

_POLL_S = 0.02
_NO_SERIAL = "a folder tells no serial number: give `serial` in the cell file's camera section, so that another camera is noticed"


def make_camera(context: DriverContext) -> FolderCamera:
    """The camera of a cell file.

    Raises:
        SettingsError: `folder` or `unit` is missing, or a setting is unknown or wrong.
    """
    settings = parse_settings(FolderSettings, context.settings, "folder")
    return FolderCamera(context.folder / settings.folder, settings)


class FolderCamera:
    """Scans that appear in a folder. Satisfies `drivers.protocols.Camera3D`.

    Args:
        folder: where they appear.
        settings: what they hold and how one is triggered.
    """

    def __init__(self, folder: Path, settings: FolderSettings) -> None:
        self.folder = folder
        """Where the scans appear."""
        self._settings = settings
        self._axes = parse_axes(settings.axes)
        self._opened = False
        self._sequence = 0
        self._unanswered: dict[str, Stamp] | None = None
        self._frames_by_sha256: dict[str, int] = {}

    def open(self) -> CameraInfo:
        """Look whether the folder is there.

        Raises:
            CameraNotReached: it is not, or cannot be read.
        """
        said = self._settings
        self._look(CameraNotReached)
        self._opened = True
        data = {"unit": said.unit, "axes": self._axes.tolist(), "grid": said.grid, "preset": said.preset}
        return CameraInfo(
            adapter="folder",
            model=said.model,
            serial=said.serial,
            settings_digest=settings_digest(data),
            onboard_correction=said.onboard_correction,
            notes=() if said.serial else (_NO_SERIAL,),
        )

    def capture(self, *, timeout_s: float) -> Frame3D:
        """Trigger, and the one scan that appears afterwards.

        When the call before ended without a scan, that scan may still come: half of the time is spent waiting for it, to
        throw it away.

        Raises:
            CameraNotReached: not open.
            CameraLost: the folder is gone, or the trigger fails.
            CameraTimeout: nothing appeared in time.
            IncompleteFrame: a file appeared and was not whole in time.
            StaleFrame: the file holds, byte for byte, a scan that was taken before.
            InvalidFrame: more than one scan appeared.
            CameraMisconfigured: unit, axes or grid of the cell file do not fit the scan.
        """
        if not self._opened:
            raise CameraNotReached("the camera's folder is not open", file=self.folder, remedy="Open the camera first.")
        end_s = time.monotonic() + timeout_s
        self._let_late_scan_pass(time.monotonic() + timeout_s / 2)
        before = self._look(CameraLost)
        path = self.folder / f"spherecal_{time.time_ns()}.ply" if self._settings.names_its_file else None
        self._unanswered = None if path else before
        triggered_s = time.monotonic()
        self._trigger(path, end_s)
        watch = Watch(self.folder, self._settings.stable_s)
        while (arrived := watch.look(path.name if path else self._new_name(before), time.monotonic())) is None:
            if time.monotonic() >= end_s:
                raise watch.too_late(timeout_s)
            time.sleep(_POLL_S)
        self._unanswered = None
        return self._frame(arrived, triggered_s)

    def close(self) -> None:
        """Forget the folder."""
        self._opened = False

    def _look(self, kind: type[CameraNotReached]) -> dict[str, Stamp]:
        try:
            return snapshot(self.folder, self._settings.patterns)
        except OSError as error:
            remedy = "Check `folder` in the cell file's camera section, and whether the share is mounted."
            raise kind(f"the camera's folder cannot be read ({error.strerror})", file=self.folder, remedy=remedy) from error

    def _new_name(self, before: dict[str, Stamp]) -> str | None:
        names = new_names(before, self._look(CameraLost))
        if len(names) > 1:
            found = f"{len(names)} files appeared after one trigger: {', '.join(names[:3])}"
            raise InvalidFrame(found, file=self.folder, remedy="Name the scans alone by `pattern`, and let one trigger give one scan.")
        return names[0] if names else None

    def _let_late_scan_pass(self, end_s: float) -> None:
        watch = Watch(self.folder, self._settings.stable_s)
        while self._unanswered is not None and time.monotonic() < end_s:
            late = new_names(self._unanswered, self._look(CameraLost))
            if late and watch.look(late[-1], time.monotonic()) is not None:
                return
            time.sleep(_POLL_S)

    def _trigger(self, path: Path | None, end_s: float) -> None:
        if self._settings.trigger_file is not None:
            try:
                write_atomic(self.folder / self._settings.trigger_file, f"{self._sequence + 1}\n".encode())
            except FileError as error:
                found = f"the trigger file cannot be written: {error.message}"
                raise CameraLost(found, file=error.file, remedy="Check the folder's permissions.") from error
        elif self._settings.command is not None:
            run_trigger([word.replace("{path}", str(path)) for word in self._settings.command], self.folder, end_s - time.monotonic())

    def _frame(self, arrived: Arrived, triggered_s: float) -> Frame3D:
        path = self.folder / arrived.name
        earlier = self._frames_by_sha256.get(arrived.sha256)
        if earlier is not None:
            remedy = "Let the camera's software export new scans only."
            raise StaleFrame(f"holds the scan of frame {earlier}, byte for byte", file=path, remedy=remedy)
        xyz_mm = frame_points(arrived.cloud, unit_mm=UNITS_MM[self._settings.unit], axes=self._axes, grid=self._settings.grid)
        require_plausible(xyz_mm, str(path))
        self._sequence += 1
        self._frames_by_sha256[arrived.sha256] = self._sequence
        return Frame3D(
            xyz_mm=xyz_mm,
            sequence=self._sequence,
            time_s=triggered_s,
            intensity=brightness(arrived.cloud, xyz_mm.shape[:2]),
            done_s=time.monotonic(),
            diagnostics={"file": arrived.name},
        )


def run_trigger(words: list[str], folder: Path, timeout_s: float) -> None:
    """Run a command, without a shell, in a folder.

    Raises:
        CameraTimeout: it did not end in time (it is killed).
        CameraLost: it cannot be run, or ends with another code than 0.
    """
    remedy = f"Run it by hand in {folder}."
    try:
        done = subprocess.run(words, cwd=folder, capture_output=True, stdin=subprocess.DEVNULL, timeout=max(0.0, timeout_s), check=False)
    except subprocess.TimeoutExpired as error:
        raise CameraTimeout(f"the trigger command {words[0]} did not end in time", where="camera.command", remedy=remedy) from error
    except OSError as error:
        raise CameraLost(f"the trigger command {words[0]} cannot be run ({error})", where="camera.command", remedy=remedy) from error
    if done.returncode != 0:
        said = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
        last = f": {said[-1][:200]}" if said else ""
        raise CameraLost(f"the trigger command {words[0]} ended with {done.returncode}{last}", where="camera.command", remedy=remedy)
