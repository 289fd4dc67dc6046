"""Predictions of artefacts: the order that METHOD.md 4 measured, and what cannot be predicted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calibrate.predict import Artefact, ArtefactPrediction, artefacts_of, box_of, own_artefact, predict_artefact, ranked, usual_artefacts
from drivers.errors import SettingsError
from tests.support.once import once_a_run
from tests.support.solving import one_thread
from tests.support.volume import volume_cell

N_SHOTS = 36


def predict_all() -> dict[str, ArtefactPrediction]:
    volume = volume_cell(0)
    with one_thread():
        groups = [predict_artefact(volume.cell, volume.model, artefact, (N_SHOTS,)) for artefact in artefacts_of(volume.cell, ["A", "B"])]
    return {p.artefact.name: p for p in ranked(groups)}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ArtefactPrediction]:
    return once_a_run(tmp_path_factory, "predictions", lambda _folder: predict_all())


def length_rms_mm(prediction: ArtefactPrediction) -> float:
    if prediction.predicted is None:
        pytest.fail(f"{prediction.artefact.name}: {prediction.reason}")
    return prediction.predicted.length_rms_mm


@pytest.mark.qualify
def test_artefacts_stand_in_the_order_they_are_really_in(found: dict[str, ArtefactPrediction]) -> None:
    rms = {name: length_rms_mm(p) for name, p in found.items()}
    assert rms["five spheres"] < min(rms["bar in three orientations"], rms["three spheres"])
    assert max(rms["bar in three orientations"], rms["three spheres"]) < rms["one bar"]
    without = ("six places", "one sphere", "two spheres", "two diameters")
    assert 3 * rms["one bar"] < min(rms[name] for name in without)
    assert list(rms.values()) == sorted(rms.values())


def test_more_shots_are_better_and_one_view_never_better_than_its_noise() -> None:
    volume = volume_cell(0)
    artefact = own_artefact(volume.cell, volume.spheres)
    with one_thread():
        few, many = predict_artefact(volume.cell, volume.model, artefact, (24, 60))
    assert length_rms_mm(many) < length_rms_mm(few)
    assert few.predicted is not None
    assert few.predicted.centre_rms_mm is not None
    assert few.predicted.centre_rms_mm > 0.02 * np.sqrt(3)


def test_every_entry_tells_the_same_keys(found: dict[str, ArtefactPrediction]) -> None:
    volume = volume_cell(0)
    far = Artefact("far", "out of reach", usual_artefacts(np.array([[5000.0, 0, 0], [5500, 500, 500]]), length_mm=500, diameter_mm=38.1)[0].spheres)
    (refused,) = predict_artefact(volume.cell, volume.model, far, (30,))
    entries = [p.to_json_dict() for p in (*found.values(), refused)]
    assert {"artefact", "n_spheres", "n_lengths", "n_shots", "centre_rms_mm", "length_rms_mm", "reason"} <= set.intersection(*map(set, entries))
    assert entries[-1]["length_rms_mm"] is None
    assert "feasible" in str(entries[-1]["reason"])
    json.dumps(entries, allow_nan=False)


def test_own_spheres_bring_their_lengths() -> None:
    cell = volume_cell(0).cell
    assert len(own_artefact(cell, ["A", "B", "C"]).lengths) == 1
    with pytest.raises(SettingsError, match="no sphere 'Q'"):
        own_artefact(cell, ["Q"])
    placeless = cell.model_copy(update={"spheres": {"A": cell.spheres["A"].model_copy(update={"centre_in_base_mm": None})}, "lengths": ()})
    with pytest.raises(SettingsError, match="place of a sphere"):
        own_artefact(placeless, ["A"])
    assert "this cell" not in {artefact.name for artefact in artefacts_of(placeless)}
    with pytest.raises(SettingsError, match="where accuracy matters"):
        box_of(placeless.model_copy(update={"work_volume_mm": None}))


def test_a_bar_has_the_cells_length_and_its_spheres_diameter() -> None:
    cell = volume_cell(0, bar_mm=420.0).cell
    bar = next(artefact for artefact in artefacts_of(cell) if artefact.name == "one bar")
    first, second = (np.array(sphere.centre_in_base_mm) for sphere in bar.spheres)
    assert np.linalg.norm(first - second) == pytest.approx(cell.lengths[0].length_mm)
    assert {sphere.diameter_mm for sphere in bar.spheres} == {38.1}
