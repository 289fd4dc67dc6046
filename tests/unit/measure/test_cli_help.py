"""`--help` is instant because it imports nothing heavy: judged by what is imported, not by the clock."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from measure.cli import app
from measure.cli_run import run_app

HEAVY = ("open3d", "rerun", "numba", "matplotlib", "trimesh", "scipy", "numpy", "yaml", "jinja2", "fcl", "llvmlite")
OURS_WHEN_NEEDED = ("calibrate", "acquire.capture", "acquire.cell", "drivers.kinematics", "drivers.simulated", "measure.verify", "measure.viewer")

PROGRAM = """
import sys
sys.argv = ["spherecal", *{arguments!r}]
from measure.cli import main
try:
    main()
except SystemExit as end:
    code = end.code
print("\\n".join(["loaded:", *sorted(sys.modules)]), file=sys.stderr)
sys.exit(code)
"""

VERBS = [
    *("demo", "new", "doctor", "plan", "predict", "capture", "centres", "calibrate", "verify", "stitch", "report", "show", "study"),
    *("simulate-controller", "abb-program", "serve-cell", "camera-check"),
]


@pytest.mark.parametrize("arguments", [["--help"], ["calibrate", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    process = subprocess.run([sys.executable, "-c", PROGRAM.format(arguments=arguments)], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    loaded = process.stderr.split("loaded:\n")[1].splitlines()
    assert "measure.cli" in loaded
    assert not {name.partition(".")[0] for name in loaded} & set(HEAVY)
    assert not [name for name in loaded if name.startswith(OURS_WHEN_NEEDED)]


def test_help_names_every_verb_of_this_version(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, ["--help"]) == 0
    out = capfd.readouterr().out
    assert all(f"\n  {verb} " in out for verb in VERBS)


@pytest.mark.parametrize("verb", [["new", "cell"], *([verb] for verb in VERBS if verb != "new")])
def test_every_verb_has_help_and_takes_the_common_flags(verb: list[str], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run_app(app, [*verb, "--help"]) == 0
    out = capfd.readouterr().out
    assert all(flag in out for flag in ("--json", "--debug", "--quiet"))
    assert max(len(line) for line in out.splitlines()) <= 80


def test_a_help_that_nobody_reads_to_the_end_makes_no_noise() -> None:
    read, write = os.pipe()
    os.close(read)
    process = subprocess.run([sys.executable, "-m", "measure.cli", "--help"], stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert process.stderr == b""
