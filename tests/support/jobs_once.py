"""One process of a runner with light work: PARTS CALIBRATION OUT; prints the summary."""

from __future__ import annotations

import sys
from pathlib import Path

from measure.console import json_text
from measure.jobs.model import Files, Recipe
from measure.jobs.parts import parts_in
from measure.jobs.pool import LocalPool
from measure.jobs.runner import Runner, RunSettings
from tests.support.job_works import light


def main(parts: Path, out: Path) -> None:
    pool = LocalPool(2, light)
    try:
        settings = RunSettings(once=True, settle_s=0.0, poll_s=0.1, back_off_s=0.05)
        summary = Runner(out, Recipe("c" * 64), Files(Path("none")), lambda: parts_in(parts), pool, settings).run()
    finally:
        pool.close()
    print(json_text(summary.to_json_dict()))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
