"""The truth file: written and read back unchanged, everything else refused with file and place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.yaml import dump_yaml
from drivers.simulated.draws import paper_truth, random_truth, table, transform_rows
from drivers.simulated.truth import FieldTruth, NoError, SphereTruth, Truth, WorkpieceTruth
from drivers.simulated.truth_file import FORMAT, load_truth, parse_truth, write_truth
from tests.support.simulated import paper_model


@pytest.mark.parametrize(
    "truth",
    [
        Truth(),
        random_truth(paper_model(), np.random.default_rng(1)),
        paper_truth(paper_model(), boxes=(table(0.0),), workpiece=WorkpieceTruth(transform_rows(np.eye(4)))),
        replace(Truth(), camera=replace(Truth().camera, error=FieldTruth(bowl_mm=0.1))),
    ],
)
def test_round_trip(truth: Truth, tmp_path: Path) -> None:
    write_truth(truth, tmp_path / "truth.yaml")
    assert load_truth(tmp_path / "truth.yaml") == truth


@given(
    seed=st.integers(0, 2**62),
    spheres=st.dictionaries(
        st.text(min_size=1, max_size=5, alphabet=st.characters(categories=("L", "N"))),
        st.builds(SphereTruth, st.tuples(*[st.floats(-1e4, 1e4)] * 3), st.floats(1.0, 500.0), st.floats(-1.0, 1.0)),
    ),
    noise=st.floats(0.0, 10.0),
)
@settings(deadline=None)
def test_any_truth_survives_its_text(seed: int, spheres: dict[str, SphereTruth], noise: float) -> None:
    from dataclasses import asdict

    truth = Truth(seed=seed, spheres=spheres, camera=replace(Truth().camera, range_noise_mm=noise))
    assert parse_truth(dump_yaml({"format": FORMAT, **asdict(truth)}), file="t") == truth


@given(st.text(max_size=200))
@settings(deadline=None)
def test_any_text_is_a_truth_or_a_file_error(text: str) -> None:
    for candidate in (text, f"format: {FORMAT}\n{text}"):
        outcome = parsed_or_error(candidate)
        assert isinstance(outcome, Truth) or (outcome.file == "t" and outcome.remedy)


def parsed_or_error(text: str) -> Truth | FileError:
    try:
        return parse_truth(text, file="t")
    except FileError as error:
        return error


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("format: spherecal-cell/1", "format"),
        ("[1, 2]", "format"),
        (f"format: {FORMAT}\nsede: 1", "sede"),
        (f"format: {FORMAT}\nseed: '1'", "seed"),
        (f"format: {FORMAT}\nseed: 1.5", "seed"),
        (f"format: {FORMAT}\nrobot: {{a_eror_mm: [1]}}", "robot.a_eror_mm"),
        (f"format: {FORMAT}\nrobot: {{pose_noise_mm: -1}}", "robot.pose_noise_mm"),
        (f"format: {FORMAT}\nrobot: {{pose_noise_mm: .nan}}", "robot.pose_noise_mm"),
        (f"format: {FORMAT}\nrobot: {{a_error_mm: [1, 2], d_error_mm: [1, 2, 3]}}", "robot"),
        (f"format: {FORMAT}\ncamera: {{error: {{kind: bowl}}}}", "camera.error"),
        (f"format: {FORMAT}\ncamera: {{error: {{kind: none, k: [1]}}}}", "camera.error.none.k"),
        (f"format: {FORMAT}\ncamera: {{flange_from_camera: [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}", "camera.flange_from_camera"),
        (f"format: {FORMAT}\nspheres: {{A: {{diameter_mm: 38.1}}}}", "spheres.A.centre_in_base_mm"),
    ],
)
def test_what_is_not_allowed_is_told_with_its_place(text: str, where: str) -> None:
    with pytest.raises(FileError) as caught:
        parse_truth(text, file="truth.yaml")
    assert caught.value.file == "truth.yaml"
    assert caught.value.where == where
    assert caught.value.remedy


def test_a_minimal_file_is_the_exact_cell() -> None:
    truth = parse_truth(f"format: {FORMAT}", file="t")
    assert truth == Truth()
    assert truth.camera.error == NoError()
