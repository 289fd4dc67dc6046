"""Results that replace earlier ones without losing them, and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.errors import FileError, SettingsError
from drivers.files.disk import read_bytes, sha256_hex

_HEAD_BYTES = 4096


@contextmanager
def replacing(path: Path, file_format: str) -> Iterator[Path | None]:
    """Move an earlier result aside, under a name that tells its content, while a new one takes its place.

    It comes back when the block fails, and goes when the new one says the same: the same bytes, or the same `id` of
    its content.

    Args:
        path: where the new result goes.
        file_format: the format that the earlier file must have; anything else was named by mistake and is not touched.

    Yields:
        Where the earlier result lies now, or None where there was none.

    Raises:
        SettingsError: the file there is something else.
    """
    if not path.exists():
        yield None
        return
    data = _earlier(path, file_format)
    former = path.with_name(f"{path.stem}-{sha256_hex(data)[:8]}{path.suffix}")
    os.replace(path, former)
    try:
        yield former
    except BaseException:
        os.replace(former, path)
        raise
    new = read_bytes(path)
    if new == data or (_content_id(data) is not None and _content_id(data) == _content_id(new)):
        former.unlink()


def _content_id(data: bytes) -> bytes | None:
    """The top-level `id:` line of a YAML file, which leaves out time and software."""
    return next((line for line in data.splitlines() if line.startswith(b"id: ")), None)


def _earlier(path: Path, file_format: str) -> bytes:
    """The bytes of an earlier result, which must be of the right format."""
    try:
        data = read_bytes(path)
    except FileError as error:
        raise _not_ours(path, file_format) from error
    if f"format: {file_format}".encode() not in data[:_HEAD_BYTES].splitlines():
        raise _not_ours(path, file_format)
    return data


def require_writable(path: Path) -> None:
    """See, before long work, that its result can be written.

    Raises:
        FileError: the folder is missing or not writable.
        SettingsError: the path is a folder.
    """
    folder = path.absolute().parent
    if not folder.is_dir():
        raise FileError("no such folder", file=folder, remedy="Make it, or name another one with -o.")
    if not os.access(folder, os.W_OK):
        raise FileError("may not be written to", file=folder, remedy="Name another folder with -o.")
    if path.is_dir():
        raise SettingsError("is a folder", file=path, remedy="Name a file with -o.")


def _not_ours(path: Path, file_format: str) -> SettingsError:
    return SettingsError(f"exists and is no {file_format} file", file=path, remedy="Name another file with -o.")


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """A folder to fill that takes its name when the block ends well, and vanishes when it does not.

    Raises:
        FileError: the folder beside which it should appear is missing or not writable.
    """
    try:
        working = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
    except OSError as error:
        remedy = "Name a place where you may write."
        raise FileError(f"cannot be made ({error.strerror})", file=target, remedy=remedy) from error
    try:
        yield working
        working.chmod(0o777 & ~_umask())
        if target.exists():
            shutil.rmtree(target)
        os.replace(working, target)
    except BaseException:
        shutil.rmtree(working, ignore_errors=True)
        raise


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
