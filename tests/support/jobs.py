"""Many small parts for the tests of jobs, some of them spoiled, and a runner in this process."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibrate.result import Calibration
from drivers.files.disk import sha256_hex
from drivers.files.ply import encode_ply
from drivers.files.yaml import dump_yaml
from measure.jobs.model import Files, Order, Outcome, Recipe, Work
from measure.jobs.outputs import keep_copy, prepare
from measure.jobs.parts import parts_in
from measure.jobs.pool import Executor
from measure.jobs.runner import Recorder, Runner, RunSettings, Summary
from measure.jobs.work import measure_part
from tests.support.recorded import PLACES, nominal_calibration, record_session, write_cell

CAMERA = "CAM-1"


@dataclass(frozen=True)
class Parts:
    """A folder of parts, and what is to be expected of them."""

    folder: Path
    calibration: Path
    good: tuple[str, ...]
    spoiled: dict[str, str]
    """Name of the part: how it was spoiled."""


def make_parts(folder: Path, n_parts: int, n_spoiled: int, seed: int) -> Parts:
    """Parts of two small scans each; the spoiled ones are spread at random and take turns in the kinds of damage."""
    rng = np.random.default_rng(seed)
    cell = write_cell(folder)
    first = record_session(folder / "first", cell, rng, shots_per_sphere=2)
    calibration = replace(nominal_calibration(cell, [first]), identity={"camera_serial": CAMERA})
    calibration.save(folder / "calibration.yaml")
    models = [record_session(folder / f"model{i}", cell, rng, shots_per_sphere=1, n_points=200, purpose="workpiece").folder for i in range(3)]
    damaged = rng.choice(n_parts, n_spoiled, replace=False)
    kinds = {int(place): list(DAMAGE)[i % len(DAMAGE)] for i, place in enumerate(damaged)}
    good, spoiled = [], {}
    for i in range(n_parts):
        name = f"part{i:04d}"
        session = folder / "parts" / name
        shutil.copytree(models[i % len(models)], session)
        edit_head(session, {"camera_serial": CAMERA, "part": name})
        if i in kinds:
            DAMAGE[kinds[i]](session)
            spoiled[name] = kinds[i]
        else:
            good.append(name)
    return Parts(folder / "parts", folder / "calibration.yaml", tuple(good), spoiled)


def edit_head(session: Path, identity: dict[str, str]) -> None:
    head = (session / "session.yaml").read_text(encoding="utf-8").split("identity:")[0]
    (session / "session.yaml").write_text(head + dump_yaml({"identity": identity}), encoding="utf-8")


def read_lines(session: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (session / "shots.jsonl").read_text(encoding="utf-8").splitlines()]


def write_lines(session: Path, lines: Sequence[dict[str, object]]) -> None:
    (session / "shots.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def truncate_scan(session: Path) -> None:
    scan = session / "scans" / "0000.ply"
    scan.write_bytes(scan.read_bytes()[:-500])


def only_nan(session: Path) -> None:
    data = encode_ply(np.full((200, 3), np.nan, dtype=np.float32), comments=("unit mm",))
    lines = read_lines(session)
    for line in lines:
        (session / str(line["scan"])).write_bytes(data)
    write_lines(session, [{**line, "sha256": sha256_hex(data)} for line in lines])


def without_joints(session: Path) -> None:
    write_lines(session, [{**line, "joints_rad": None} for line in read_lines(session)])


def break_line(session: Path) -> None:
    first, *others = (session / "shots.jsonl").read_text(encoding="utf-8").splitlines()
    (session / "shots.jsonl").write_text("\n".join([first[: len(first) // 2], *others, ""]), encoding="utf-8")


def other_camera(session: Path) -> None:
    edit_head(session, {"camera_serial": "CAM-2"})


def no_shots(session: Path) -> None:
    (session / "shots.jsonl").write_bytes(b"")


DAMAGE: dict[str, Callable[[Path], None]] = {
    "truncated scan": truncate_scan,
    "only NaN": only_nan,
    "no joints": without_joints,
    "broken line": break_line,
    "other camera": other_camera,
    "no shots": no_shots,
}


def draw_ball(folder: Path, *, tolerance_mm: float = 20.0) -> tuple[Path, Path]:
    """Mesh and inspection.yaml of the sphere A that the parts hold."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=3, radius=19.05)
    mesh.apply_translation(PLACES["A"])
    mesh.export(folder / "part.stl")
    spec = {
        "format": "spherecal-inspection/1",
        "features": {"ball": {"kind": "sphere", "centre_mm": list(PLACES["A"]), "diameter_mm": 38.1, "axis": [0, 0, 1], "cap_deg": 80}},
        "checks": [{"kind": "diameter", "feature": "ball", "name": "ball", "tolerance": tolerance_mm}],
    }
    (folder / "inspection.yaml").write_text(dump_yaml(spec), encoding="utf-8")
    return folder / "part.stl", folder / "inspection.yaml"


class InPlace:
    """An executor that does each job when it is submitted, in this process."""

    def __init__(self, work: Work = measure_part, n_workers: int = 1) -> None:
        self.work, self.n_workers = work, n_workers
        self.orders: list[Order] = []
        self.most_flying = 0
        self._ended: list[tuple[str, Outcome]] = []

    @property
    def n_free(self) -> int:
        return self.n_workers - len(self._ended)

    def submit(self, ticket: str, order: Order) -> None:
        self.orders.append(order)
        self._ended.append((ticket, self.work(order)))
        self.most_flying = max(self.most_flying, len(self._ended))

    def collect(self, timeout_s: float) -> list[tuple[str, Outcome]]:
        if not self._ended:
            time.sleep(min(timeout_s, 0.02))
        ended, self._ended = self._ended, []
        return ended

    def close(self) -> None:
        pass


def run_jobs(
    parts: Parts,
    out: Path,
    executor: Executor | None = None,
    *,
    recipe: Recipe | None = None,
    files: Files | None = None,
    recorder: Recorder | None = None,
    history: str | None = None,
    on_made: Callable[[Runner], None] | None = None,
    retry_dead: bool = False,
    retries: int = 3,
    memory_mb: float | None = None,
    give_up_after_s: float = 3600.0,
) -> Summary:
    """Drain a folder in this process."""
    settings = RunSettings(once=True, settle_s=0.0, poll_s=0.01, back_off_s=0.01, history=history, retry_dead=retry_dead, retries=retries)
    settings = replace(settings, memory_mb=memory_mb, give_up_after_s=give_up_after_s)
    prepare(out)
    copy, _ = keep_copy(out, parts.calibration)
    given = recipe or Recipe(Calibration.load(copy).id)
    runner = Runner(out, given, files or Files(copy), lambda: parts_in(parts.folder), executor or InPlace(), settings, recorder=recorder)
    if on_made is not None:
        on_made(runner)
    return runner.run()
