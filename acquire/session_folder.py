"""What lies around the writing of a session: its folder, its lock, its repair, its cell."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path

from acquire.cell import Cell, robot_model_of
from drivers.errors import FileError, SettingsError
from drivers.files.disk import decode_text, read_bytes, sync_folder, write_atomic
from drivers.files.session import read_head
from drivers.files.shots import parse_shot
from drivers.files.yaml import parse_yaml


def check_free(target: Path) -> None:
    """Refuse a folder that is in use, or that nothing can be written to.

    Raises:
        FileError: it is not empty, no folder, or it cannot be made or written.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        remedy = "Choose another folder, or continue the run in it with `spherecal capture --resume`."
        raise FileError("is there already and not an empty folder", file=target, remedy=remedy)
    there = next(folder for folder in (target.absolute(), *target.absolute().parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        remedy = "Choose another folder, or check permissions and disk."
        raise FileError(f"cannot be made ({there} is no folder that can be written)", file=target, remedy=remedy)


def make_folder(target: Path, files: Mapping[str, bytes]) -> None:
    """Put a folder with an empty scans/ in place at once: made under another name, then renamed.

    Args:
        target: the folder.
        files: name and bytes of what lies in it.

    Raises:
        FileError: it cannot be made; nothing is left behind then.
    """
    missing = [folder for folder in (target.absolute().parent, *target.absolute().parent.parents) if not folder.exists()]
    temporary: Path | None = None
    try:
        target.absolute().parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.absolute().parent))
        temporary.chmod(0o755)
        (temporary / "scans").mkdir()
        for name, data in files.items():
            write_atomic(temporary / name, data)
        temporary.rename(target)
        sync_folder(target.absolute().parent)
    except BaseException as error:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            raise FileError(f"cannot be made ({error.strerror or error})", file=target, remedy="Choose a folder that can be written.") from error
        raise


def open_locked(path: Path) -> FileIO:
    """Open a file for writing that no other process has open in this way.

    Raises:
        FileError: it is missing, not writable, or in use.
    """
    try:
        stream = FileIO(path, "rb+")
    except OSError as error:
        raise FileError(f"cannot be opened ({error.strerror})", file=path, remedy="Check the session's folder and its permissions.") from error
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        stream.close()
        raise FileError("another process is writing to this session", file=path.parent, remedy="End the other run first.") from error
    except OSError as error:
        stream.close()
        raise FileError(f"cannot be locked ({error.strerror})", file=path, remedy="Record on a local disk.") from error
    return stream


def repair(folder: Path, stream: FileIO) -> str | None:
    """Take a half-written last line out, give a whole one its line end, remove temporary scans.

    Args:
        folder: the session.
        stream: its locked shots.jsonl.

    Returns:
        What was taken out, for the user; None where nothing was.
    """
    for left_over in (folder / "scans").glob(".*.tmp"):
        left_over.unlink(missing_ok=True)
    path = folder / "shots.jsonl"
    data = read_bytes(path)
    start = data.rfind(b"\n") + 1
    if start == len(data):
        return None
    try:
        parse_shot(decode_text(data[start:], file=path), folder=folder, file=path, where="last line")
    except FileError:
        stream.truncate(start)  # the shot of this line was never told as done
        os.fsync(stream.fileno())
        return f"{path}: the last line was cut off by a killed run and is taken out; its shot has to be taken again."
    stream.seek(0, os.SEEK_END)
    stream.write(b"\n")
    os.fsync(stream.fileno())
    return None


def check_same_cell(folder: Path, cell: Cell) -> None:
    """Refuse a cell that says something else than the session's copy; comments and layout may differ.

    Raises:
        SettingsError: the cell or its robot model differs.
    """
    copy = folder / str(read_head(folder).relative_path("cell"))
    data = read_bytes(copy)
    if data != cell.data and _plain(data, copy) != _plain(cell.data, cell.path):
        remedy = "Resume with the cell file of its start, or begin a new session."
        raise SettingsError(f"the session was begun in another cell than {cell.path}", file=copy, remedy=remedy)
    model_path, model = folder / "robot_model.yaml", robot_model_of(cell)
    if model is not None and model_path.exists() and _plain(model.text.encode(), model_path) != _plain(read_bytes(model_path), model_path):
        raise SettingsError("the robot model has changed since the session was begun", file=model_path, remedy="Begin a new session.")


def _plain(data: bytes, path: Path) -> object:
    return parse_yaml(decode_text(data, file=path), file=path)
