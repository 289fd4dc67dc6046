"""Robot models: shipped by name, or read from a file of the user (format spherecal-robot/1, DESIGN 3).

A model holds nominal geometry only. What a calibration found lives in the calibration file.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import numpy as np

from drivers.errors import FileError
from drivers.files.disk import read_text
from drivers.files.yaml import dump_yaml, parse_yaml
from drivers.kinematics.mdh import RobotModel

__all__ = ["load_robot_model", "parse_robot_model", "robot_model_data", "robot_model_from_data", "shipped_models"]


def shipped_models() -> tuple[str, ...]:
    """Names of the models that come with spherecal, sorted."""
    names = (entry.name for entry in resources.files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml")))


def load_robot_model(name_or_path: str | Path, *, relative_to: str | Path | None = None) -> RobotModel:
    """The shipped model of that name, or else the model in the file at that path.

    Args:
        name_or_path: e.g. "abb_irb1410" or "my_robot.yaml".
        relative_to: folder that a relative path starts from (that of the cell file); the working folder if None.

    Raises:
        FileError: no such model or file, or its content is not allowed.
    """
    if str(name_or_path) in shipped_models():
        resource = resources.files(__name__) / f"{name_or_path}.yaml"
        return parse_robot_model(resource.read_text(encoding="utf-8"), file=f"{name_or_path}.yaml")
    path = Path(relative_to or ".") / name_or_path
    if not path.is_file():
        choices = ", ".join(shipped_models())
        raise FileError(f"no robot model {str(name_or_path)!r}", file=path, remedy=f"Give the path of a model file, or one of {choices}.")
    return parse_robot_model(read_text(path), file=path)


def parse_robot_model(text: str, *, file: str | Path) -> RobotModel:
    """The model that a YAML text describes; `file` is named in errors.

    Raises:
        FileError: no YAML, or a key, type or value that is not allowed; with file, key path and remedy.
    """
    from drivers.files.schema import check
    from drivers.models.schema import RobotFile

    return check(RobotFile, parse_yaml(text, file=file), file=str(file), text=text).model(text)


def robot_model_from_data(data: object, *, file: str | Path) -> RobotModel:
    """The model that plain data describe, as they stand inside another file (`robot_model` of a calibration).

    Raises:
        FileError: a key, type or value that is not allowed.
    """
    from drivers.files.schema import check
    from drivers.models.schema import RobotFile

    return check(RobotFile, data, file=str(file)).model(dump_yaml(data))


def robot_model_data(model: RobotModel) -> Mapping[str, object]:
    """The plain data of a model; `robot_model_from_data` gives an equal model back."""
    links = zip(model.a_mm, model.alpha_rad, model.d_mm, model.theta_offset_rad, strict=True)
    data: dict[str, object] = {
        "format": "spherecal-robot/1",
        "name": model.name,
        "links": [{"a_mm": float(a), "alpha_rad": float(alpha), "d_mm": float(d), "theta_offset_rad": float(t)} for a, alpha, d, t in links],
        "coupling": model.coupling.tolist(),
        "linear_limits_rad": [{"row": limit.row.tolist(), "min": limit.lower_rad, "max": limit.upper_rad} for limit in model.linear_limits],
        "source": model.source,
        "shape": [{"link": c.link, "start_mm": list(c.start_mm), "end_mm": list(c.end_mm), "radius_mm": c.radius_mm} for c in model.shape],
    }
    if np.isfinite(model.joint_limits_rad).all():
        data["joint_limits_rad"] = model.joint_limits_rad.tolist()
    return data
