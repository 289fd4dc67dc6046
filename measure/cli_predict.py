"""`spherecal predict`: which artefact, and how many shots, before anything is bought or moved."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, EarlierCalibration, Quiet, command

if TYPE_CHECKING:
    from calibrate.predict import ArtefactPrediction
    from measure.console import Console


def predict(
    cell: Annotated[Path, typer.Argument(help="The cell file: robot, camera, hand-eye guess, work volume.")],
    spheres: Annotated[
        list[str] | None, typer.Option("--spheres", help="Spheres of the cell to judge together, e.g. A,B; all of known place if left out.")
    ] = None,
    n: Annotated[list[str] | None, typer.Option("-n", help="Numbers of shots, e.g. 30,60,120 (the default).")] = None,
    calibration: EarlierCalibration = None,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other poses.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Compare artefacts and numbers of shots by the accuracy to expect. Moves nothing, writes nothing."""
    with command(as_json, debug, quiet) as run:
        from threadpoolctl import threadpool_limits

        from acquire.cell import load_cell
        from calibrate import Calibration
        from calibrate.design_cell import expectation_of
        from calibrate.predict import DEFAULT_SHOTS, artefacts_of, predict_artefact, ranked
        from measure.planning import needed_of

        counts = sorted({_number(text) for text in _pieces(n)}) or list(DEFAULT_SHOTS)
        loaded = load_cell(cell)
        model, _ = needed_of(loaded)
        expectation = None if calibration is None else expectation_of(Calibration.load(calibration))
        artefacts = artefacts_of(loaded, _pieces(spheres))
        found = []
        with run.console.progress("predicting") as advance, threadpool_limits(limits=1, user_api="blas"):
            for done, artefact in enumerate(artefacts, start=1):
                found.append(predict_artefact(loaded, model, artefact, counts, seed=seed, expectation=expectation))
                advance(done, len(artefacts))
        predictions = ranked(found)
        _tell(run.console, predictions)
        run.finish({"predicted": [prediction.to_json_dict() for prediction in predictions]})


def _tell(console: Console, predictions: tuple[ArtefactPrediction, ...]) -> None:
    counts = sorted({p.n_shots for p in predictions})
    by_name: dict[str, dict[int, ArtefactPrediction]] = {}
    for p in predictions:
        by_name.setdefault(p.artefact.name, {})[p.n_shots] = p
    rows = [
        [name, *[f.length_rms_mm if (f := group[count].predicted) else None for count in counts], *_at_most(group[counts[-1]])]
        for name, group in by_name.items()
    ]
    columns = ["artefact", *[f"{count} shots" for count in counts], "of it unmodelled", "one view"]
    console.table("lengths over the work volume, one sigma in mm", columns, rows)
    for artefact in dict.fromkeys(p.artefact for p in predictions):
        console.say(f"{artefact.name}: {artefact.description}")
    for reason in dict.fromkeys(f"{p.artefact.name}: {p.reason}" for p in predictions if p.reason):
        console.say(reason)
    console.say("Shots are chosen as `spherecal plan` does. The last two columns are for the most shots: the part that no model")
    console.say("describes (arm, camera; of usual size), and the distance of one view's centre from the mean of many.")


def _at_most(prediction: ArtefactPrediction) -> list[float | None]:
    figures = prediction.predicted
    return [None, None] if figures is None else [figures.length_mismatch_rms_mm, figures.centre_rms_mm]


def _pieces(given: list[str] | None) -> list[str]:
    return [piece.strip() for text in given or [] for piece in text.split(",") if piece.strip()]


def _number(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= _MOST_SHOTS:
        raise typer.BadParameter(f"{text!r} is no number of shots from 1 to {_MOST_SHOTS}", param_hint="-n")
    return int(text)


_MOST_SHOTS = 2000
