"""Errors, JSON and exit codes of every command, on commands of the test's own."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DataError, FileError, MotionInterrupted, SpherecalError
from measure.cli_run import AsJson, Debug, Quiet, Run, command, run_app, stopped_by_signals
from measure.console import Console, json_text

Body = Callable[[Run], None]


def run_body(body: Body, *flags: str) -> int:
    app = typer.Typer(rich_markup_mode=None)

    @app.command()
    def verb(as_json: AsJson = False, debug: Debug = False, quiet: Quiet = False) -> None:
        with command(as_json, debug, quiet) as run:
            body(run)

    return run_app(app, list(flags))


def raising(error: BaseException) -> Body:
    def body(_run: Run) -> None:
        raise error

    return body


def test_a_result_is_one_json_object_and_nothing_else_on_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    def body(run: Run) -> None:
        print("a chatty library")
        os.write(1, b"a chatty C++ library\n")
        run.console.say("for people")
        run.console.table("t", ["a", "b"], [["x", 1.0]])
        run.finish({"value": np.float64("nan"), "points": np.arange(3), "path": Path("a/b"), "nested": [{"inf": float("inf")}]})

    assert run_body(body, "--json") == 0
    out, err = capfd.readouterr()
    assert out.count("\n") == 1
    assert json.loads(out) == {"value": None, "points": [0, 1, 2], "path": "a/b", "nested": [{"inf": None}]}
    assert "a chatty library" in err
    assert "a chatty C++ library" in err
    assert "for people" not in err


@pytest.mark.parametrize(("verdict", "code"), [("pass", 0), ("marginal", 0), ("fail", 3), ("conform", 0), ("not_proven", 0), ("reject", 3)])
def test_a_bad_verdict_is_exit_3(verdict: str, code: int, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_body(lambda run: run.finish({"verdict": verdict}, verdict=verdict), "--json") == code
    assert json.loads(capfd.readouterr().out) == {"verdict": verdict}


@pytest.mark.parametrize("kind", [FileError, DataError, MotionInterrupted])
def test_an_error_of_ours_is_one_line_and_an_object(kind: type[SpherecalError], capfd: pytest.CaptureFixture[str]) -> None:
    error = kind("found\na thing", file="cell.yaml", where="line 3", remedy="Do\nthis.")
    assert run_body(raising(error), "--json") == 1
    out, err = capfd.readouterr()
    assert err == "error: cell.yaml, line 3: found a thing. Do this.\n"
    told = json.loads(out)["error"]
    assert told["type"] == kind.__name__
    assert set(told) == {"type", "message", "file", "where", "remedy"}


def test_a_long_error_is_not_wrapped_and_survives_quiet(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run_body(raising(FileError("x " * 200, file="/" + "long/" * 40)), "-q") == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1


def test_an_unexpected_error_asks_for_debug_and_debug_shows_the_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_body(raising(ZeroDivisionError("oh\nno"))) == 1
    err = capfd.readouterr().err
    assert err.count("\n") == 1
    assert "ZeroDivisionError: oh no" in err
    assert "--debug" in err
    assert run_body(raising(ZeroDivisionError("oh\nno")), "--debug") == 1
    assert "Traceback" in capfd.readouterr().err


def test_trouble_of_the_file_system_is_no_bug(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def body(_run: Run) -> None:
        (tmp_path / "none" / "x").write_text("")

    assert run_body(body, "--json") == 1
    out, err = capfd.readouterr()
    assert json.loads(out)["error"]["file"] == str(tmp_path / "none" / "x")
    assert "bug" not in err


def test_an_interrupt_is_130(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_body(raising(KeyboardInterrupt()), "--json") == 130
    out, err = capfd.readouterr()
    assert json.loads(out)["error"]["type"] == "Interrupted"
    assert err == "interrupted\n"


def test_sigterm_ends_a_run_as_ctrl_c_does(capfd: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)

    def body(_run: Run) -> None:
        with stopped_by_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()

    assert run_body(body) == 130
    assert signal.getsignal(signal.SIGTERM) is before
    assert capfd.readouterr().err == "interrupted\n"


def test_usage_errors_are_exit_2_and_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_body(lambda run: None, "--nonsense") == 2
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert run_body(lambda run: None, "--nonsense", "--json") == 2
    assert json.loads(capfd.readouterr().out)["error"]["type"] == "UsageError"


def test_log_lines_go_to_stderr_each_in_one_line_and_python_warnings_with_debug_only(capfd: pytest.CaptureFixture[str]) -> None:
    handlers, level = list(logging.getLogger().handlers), logging.getLogger().level

    def body(run: Run) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.warn("first\nsecond", stacklevel=1)
        logging.getLogger("acquire.test").warning("torn line\nrepaired")
        logging.getLogger("acquire.test").debug("not shown")
        run.finish({})

    assert run_body(body, "--json") == 0
    out, err = capfd.readouterr()
    assert (out, err) == ("{}\n", "warning: torn line repaired\n")
    assert run_body(body, "--debug") == 0
    err = capfd.readouterr().err
    assert "UserWarning: first second" in err
    assert "debug: not shown\n" in err
    assert (logging.getLogger().handlers, logging.getLogger().level) == (handlers, level)


def test_quiet_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    def body(run: Run) -> None:
        run.console.note("note")
        run.console.say("result")
        run.console.table("t", ["a"], [["x"]])
        with run.console.progress("work") as advance:
            advance(1, 2)
        run.finish({})

    assert run_body(body, "-q") == 0
    assert capfd.readouterr() == ("", "")


def test_a_table_fits_80_columns_without_terminal_or_colour(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    for columns in ("80", "20"):
        monkeypatch.setenv("COLUMNS", columns)
        Console().table("title", ["name", "a", "b"], [["[not markup]", 1.23456, None], ["nan", float("nan"), 3]])
        out = capsys.readouterr().out
        assert "\x1b" not in out
        assert "[not markup]" in out
        assert "1.235" in out
        assert max(len(line) for line in out.splitlines()) <= 80


PIPE_PROGRAM = """
import sys
from measure.cli_run import command, run_app
import typer
app = typer.Typer()
@app.command()
def verb() -> None:
    with command(False, False, False) as run:
        for i in range(20000):
            run.console.say("a line of some length")
        open(sys.argv[1], "w").write("done")
code = run_app(app, [])
sys.exit(code)
"""


def test_a_reader_that_goes_away_stops_neither_the_work_nor_makes_a_noise(tmp_path: Path) -> None:
    done = tmp_path / "done"
    with subprocess.Popen([sys.executable, "-c", PIPE_PROGRAM, str(done)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        if process.stdout is None or process.stderr is None:
            pytest.fail("no pipes")
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0
    assert done.read_text() == "done"


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(values)
def test_every_value_is_strict_json(value: object) -> None:
    def refuse(token: str) -> object:
        pytest.fail(f"{token} is no JSON")

    text = json_text(value)
    json.loads(text, parse_constant=refuse)
    assert "\n" not in text
