"""A Rerun recording as a file: beside its place until it is whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import FileError

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb


@contextmanager
def recording_file(path: str | Path, *, name: str = "spherecal", layout: rrb.BlueprintLike | None = None) -> Iterator[rr.RecordingStream]:
    """A stream into a file that appears when the block has ended, and not at all when it fails.

    Args:
        path: of the recording.
        name: of the application, by which the viewer keeps what a person changed of the layout.
        layout: how the viewer shows it at first.

    Raises:
        FileError: the folder is missing or not writable.
    """
    import rerun as rr

    target = Path(path)
    if not target.absolute().parent.is_dir():
        raise FileError("the folder does not exist", file=target, remedy="Make the folder first.")
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    stream = rr.RecordingStream(name)
    try:
        try:
            stream.save(temporary, default_blueprint=layout)
        except (OSError, RuntimeError) as error:
            raise FileError(f"cannot be written ({error})", file=target, remedy="Check that the folder is writable and has room.") from error
        yield stream
        stream.flush()
        stream.disconnect()
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise
