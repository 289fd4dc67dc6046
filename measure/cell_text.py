"""The text of a new cell file: what was answered, and comments that say what else may stand there."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.errors import SettingsError

SPHERE_FORM = "NAME:DIAMETER:U"
LENGTH_FORM = "A:B:LENGTH:U"

_TEMPLATE = """\
format: spherecal-cell/1
name: {name}
robot: {{driver: {robot}, model: {model}}}   # then the driver's own settings; model: a shipped name, a file, or null (flange poses only)
camera: {{driver: {camera}, kind: {kind}}}   # then the driver's own settings; working_range_mm: [250, 750], field_of_view_deg: [55, 36]
flange_from_camera: null   # a first guess as four rows of a rigid transform, where there is one; planning needs it

# certified spheres; centre_in_base_mm: [x, y, z] where they roughly stand lets `plan` find poses
spheres:{spheres}
# certified lengths between two spheres; a sphere moved on a slide is two spheres
lengths:{lengths}
# what `pass` and `conform` mean here; without limits a verdict is at best `marginal` or `not_proven`
# limits: {{centre_rms_mm: 0.2, length_error_mm: 0.2, diameter_error_mm: 0.1, form_mm: 0.3}}

# where accuracy matters, base frame
# work_volume_mm: [[700, -300, 200], [1100, 300, 600]]

motion: {{speed_rad_s: 0.3, settle_s: 0.5, frames: 1}}
"""


@dataclass(frozen=True, slots=True)
class CellAnswers:
    """What a new cell file is made of; spheres and lengths as typed, `A:38.1:0.001` and `A:B:500.012:0.003`."""

    name: str = "cell"
    robot: str = "simulated"
    model: str = "none"
    camera: str = "simulated"
    kind: str = "area"
    spheres: Sequence[str] = ()
    lengths: Sequence[str] = ()


def cell_text(answers: CellAnswers) -> str:
    """YAML of a new cell.

    Raises:
        SettingsError: a sphere or length is not written as it should be.
    """
    return _TEMPLATE.format(
        name=json.dumps(answers.name),
        robot=json.dumps(answers.robot),
        model="null" if answers.model in ("none", "null", "") else json.dumps(answers.model),
        camera=json.dumps(answers.camera),
        kind=json.dumps(answers.kind),
        spheres=_block([_sphere_line(text) for text in answers.spheres], "{}"),
        lengths=_block([_length_line(text) for text in answers.lengths], "[]"),
    )


def _block(lines: Sequence[str], empty: str) -> str:
    return "\n" + "\n".join(lines) + "\n" if lines else f" {empty}\n"


def _sphere_line(text: str) -> str:
    parts = _parts(text, SPHERE_FORM)
    diameter, expanded = _positive(parts[1:], text, SPHERE_FORM)
    return f"  {json.dumps(parts[0])}: {{diameter_mm: {diameter!r}, expanded_uncertainty_mm: {expanded!r}}}"


def _length_line(text: str) -> str:
    parts = _parts(text, LENGTH_FORM)
    length, expanded = _positive(parts[2:], text, LENGTH_FORM)
    return f"  - {{between: [{json.dumps(parts[0])}, {json.dumps(parts[1])}], length_mm: {length!r}, expanded_uncertainty_mm: {expanded!r}}}"


def _parts(text: str, form: str) -> list[str]:
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != form.count(":") + 1 or not all(parts):
        raise _bad(text, form)
    return parts


def _positive(parts: Sequence[str], text: str, form: str) -> list[float]:
    try:
        numbers = [float(part) for part in parts]
    except ValueError as error:
        raise _bad(text, form) from error
    if not all(math.isfinite(number) and number > 0 for number in numbers):
        raise _bad(text, form)
    return numbers


def _bad(text: str, form: str) -> SettingsError:
    option = "--sphere" if form == SPHERE_FORM else "--length"
    return SettingsError(f"{text!r} is not of the form {form}", where=option, remedy="Give positive numbers in mm, U with k = 2.")
