"""Reading and writing whole files so that nobody ever sees a half-written one."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from drivers.errors import FileError

_BYTE_LIMIT = 256 * 1024 * 1024


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a file.

    Raises:
        FileError: when it is missing, a folder, unreadable, or larger than 256 MiB (no text file of ours is).
    """
    try:
        with open(path, "rb") as stream:
            data = stream.read(_BYTE_LIMIT + 1)
    except FileNotFoundError as error:
        raise FileError("no such file", file=path, remedy="Check the path.") from error
    except IsADirectoryError as error:
        raise FileError("this is a folder, not a file", file=path, remedy="Name a file inside it.") from error
    except (OSError, ValueError) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Check the path and its permissions.") from error
    if len(data) > _BYTE_LIMIT:
        raise FileError(f"larger than {_BYTE_LIMIT >> 20} MiB", file=path, remedy="This cannot be the file that is meant.")
    return data


def read_text(path: str | Path) -> str:
    """The text of a UTF-8 file, a byte-order mark dropped.

    Raises:
        FileError: as `read_bytes`, and where the bytes are not UTF-8.
    """
    return decode_text(read_bytes(path), file=path)


def decode_text(data: bytes, *, file: str | Path) -> str:
    """UTF-8 bytes as text, a byte-order mark dropped, line ends as they are.

    Raises:
        FileError: where the bytes are not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FileError(
            f"byte 0x{data[error.start]:02x} is not UTF-8", file=file, where=f"line {line}", remedy="Save the file as UTF-8."
        ) from error


def sha256_hex(data: bytes) -> str:
    """The sha256 digest, 64 lower-case hex digits."""
    return hashlib.sha256(data).hexdigest()


def write_atomic(path: str | Path, *chunks: bytes | memoryview) -> None:
    """Write a file in one step: temporary file beside it, fsync, rename, fsync of the folder.

    A killed or failing write leaves the former file, or none.

    Raises:
        FileError: when the folder is missing or not writable, or the disk is full.
    """
    write_atomic_pieces(path, chunks)


def write_atomic_pieces(path: str | Path, chunks: Iterable[bytes | memoryview]) -> None:
    """`write_atomic` for pieces that are made one after the other; where making one fails, so does the write."""
    target = Path(path)
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
    except OSError as error:
        raise _not_writable(target, error) from error
    try:
        with open(descriptor, "wb") as stream:
            os.fchmod(stream.fileno(), usual_mode())
            for chunk in chunks:
                stream.write(chunk)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
        sync_folder(target.parent)
    except BaseException as error:
        with suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            raise _not_writable(target, error) from error
        raise


def write_text_atomic(path: str | Path, text: str) -> None:
    """`write_atomic` for UTF-8 text."""
    write_atomic(path, text.encode("utf-8"))


def sync_folder(folder: str | Path) -> None:
    """Make a new or renamed directory entry survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_DIRECTORY", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _not_writable(path: Path, error: OSError) -> FileError:
    reason = error.strerror or str(error)
    return FileError(f"cannot be written ({reason})", file=path, remedy="Check that the folder exists, is writable and has room.")


def usual_mode() -> int:
    """Of a new file: mkstemp makes files that only their owner can read."""
    # the umask can only be read by setting it
    mask = os.umask(0o077)
    os.umask(mask)
    return 0o666 & ~mask
