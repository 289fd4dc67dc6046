"""How every command runs: its common flags, its errors in one line, its one JSON object, its exit code.

0 done - 1 an error, told in one line with a remedy - 2 usage - 3 done, but `fail` or `reject` - 130 interrupted
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from drivers.errors import FileError, SpherecalError
from measure.console import Console, json_text, mute, write_line

EXIT_ERROR = 1
EXIT_USAGE = 2
EXIT_NOT_GOOD = 3
EXIT_INTERRUPTED = 130

BAD_VERDICTS = ("fail", "reject")

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, everything else on stderr.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error and the log.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
EarlierCalibration = Annotated[
    Path | None, typer.Option("--calibration", help="An earlier calibration of this cell: its noise is expected instead of a usual one.")
]


@dataclass(slots=True)
class Run:
    """One command while it runs."""

    console: Console
    result: Mapping[str, object] = field(default_factory=dict)
    exit_code: int = 0

    def finish(self, result: Mapping[str, object], *, verdict: str | None = None) -> None:
        """Hand over what `--json` prints; a `fail` or `reject` makes the exit code 3."""
        self.result = result
        self.exit_code = EXIT_NOT_GOOD if verdict in BAD_VERDICTS else 0


@contextmanager
def command(as_json: bool, debug: bool, quiet: bool) -> Iterator[Run]:
    """Run the body of a command: errors become one line and an exit code, the result one JSON object.

    Raises:
        typer.Exit: with the exit code of the command; usage errors pass through.
    """
    console = Console(as_json=as_json, quiet=quiet)
    run = Run(console)
    failure: Mapping[str, object] | None = None
    with ExitStack() as stack:
        if as_json:
            stack.enter_context(_stdout_kept_free())
        stack.enter_context(_log_to_stderr(debug, quiet))
        try:
            yield run
        except (typer.Exit, typer.TyperException):
            raise
        except (Exception, KeyboardInterrupt) as error:
            failure, run.exit_code = _told(error, console, debug)
    if as_json:
        write_line(sys.stdout, json_text({"error": failure} if failure is not None else run.result))
    if run.exit_code:
        raise typer.Exit(run.exit_code)


def _told(error: BaseException, console: Console, debug: bool) -> tuple[Mapping[str, object], int]:
    """Tell an error in one line; give the object for `--json` and the exit code."""
    if debug:
        console.error("".join(traceback.format_exception(error)).rstrip())
    if isinstance(error, KeyboardInterrupt):
        console.error("interrupted")
        return _error_object("Interrupted", "interrupted from the keyboard or by a signal"), EXIT_INTERRUPTED
    known = _as_ours(error)
    if known is not None:
        console.error(f"error: {known}")
        return known.as_dict(), known.exit_code
    message = f"unexpected {type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
    remedy = "This is a bug in spherecal: run the command again with --debug and report the traceback."
    console.error(f"error: {message}. {remedy}")
    return _error_object(type(error).__name__, message, remedy), EXIT_ERROR


def _as_ours(error: BaseException) -> SpherecalError | None:
    """An error of our tree, or a trouble with a file that the operating system reports, which is no bug."""
    if isinstance(error, SpherecalError):
        return error
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        remedy = "Check the path, the permissions and the space on the disk."
        return FileError(error.strerror[:1].lower() + error.strerror[1:], file=os.fsdecode(error.filename), remedy=remedy)
    return None


def _error_object(kind: str, message: str, remedy: str | None = None) -> Mapping[str, object]:
    return {"type": kind, "message": message, "file": None, "where": None, "remedy": remedy}


@contextmanager
def _stdout_kept_free() -> Iterator[None]:
    """Send everything that is written to stdout meanwhile, by C++ libraries too, to stderr."""
    kept, python_stdout = os.dup(1), sys.stdout
    python_stdout.flush()
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    try:
        yield
    finally:
        sys.stdout = python_stdout
        os.dup2(kept, 1)
        os.close(kept)


class _OneLine(logging.Formatter):
    """A log record, or a Python warning, in one line."""

    def format(self, record: logging.LogRecord) -> str:
        """The level and the message, without line breaks."""
        return f"{record.levelname.lower()}: {' '.join(record.getMessage().split())}"


@contextmanager
def _log_to_stderr(debug: bool, quiet: bool) -> Iterator[None]:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine())
    root, former = logging.getLogger(), logging.getLogger().level
    root.addHandler(handler)
    root.setLevel(logging.DEBUG if debug else logging.ERROR if quiet else logging.WARNING)
    # warnings of Python and numpy speak to developers; ours to users are log records
    logging.getLogger("py.warnings").setLevel(logging.WARNING if debug else logging.ERROR)
    for chatty in ("numba", "matplotlib", "PIL", "trimesh"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    logging.captureWarnings(True)
    try:
        yield
    finally:
        logging.captureWarnings(False)
        root.setLevel(former)
        root.removeHandler(handler)


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end a run as Ctrl-C does: the robot is stopped on the way out."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    former = [(number, signal.signal(number, interrupt)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in former:
            signal.signal(number, handler)


def run_app(app: Callable[..., object], arguments: list[str]) -> int:
    """Run the typer app and give the exit code; usage errors are told on stderr and, with `--json`, on stdout too."""
    try:
        code = app(arguments, standalone_mode=False)
    except typer.TyperException as error:
        return _usage_told(error, "--json" in arguments)
    except typer.Abort:
        Console().error("interrupted")
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        mute(sys.stdout)
        return EXIT_ERROR
    return code if isinstance(code, int) else 0


def _usage_told(error: typer.TyperException, as_json: bool) -> int:
    line = " ".join(error.format_message().split())
    context = getattr(error, "ctx", None)
    help_command = f"{context.command_path} --help" if context is not None else "spherecal --help"
    if type(error).__name__ == "NoArgsIsHelpError":
        write_line(sys.stderr, error.format_message())
    else:
        write_line(sys.stderr, f"usage error: {line} Try '{help_command}'.")
    if as_json:
        write_line(sys.stdout, json_text({"error": _error_object("UsageError", line, f"Try '{help_command}'.")}))
    return EXIT_USAGE
