"""Writes a `Scene` as a Rerun recording (.rrd) with its layout. Only the viewer modules import rerun.

A debug view, never the record of truth: Rerun promises to open only files of the version before. Lengths are logged in
metres, where the viewer's eye and grid are sensible, and named in mm in the texts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.mdh import Capsule
from measure.scene import Scene, SphereCloud, SphereMark, Step
from measure.viewer_file import recording_file
from measure.viewer_surroundings import log_surroundings

if TYPE_CHECKING:
    import rerun as rr

FloatArray = NDArray[np.float64]

TIMELINE = "pose"
BEFORE_COLOUR = (226, 114, 43)
AFTER_COLOUR = (38, 166, 190)
STITCHED_COLOUR = (190, 200, 210)
ROBOT_COLOUR = (150, 158, 172, 255)

_MM = 1e-3
_UI_POINT = -1.5  # negative radii are pixels
_POINTS_PER_STEP = 20_000
_POINTS_OF_ALL_STEPS = 60_000


def write_recording(path: str | Path, scene: Scene) -> Path:
    """Write a recording beside `path` and rename it into place; returns the path.

    Raises:
        FileError: the folder is missing or not writable.
    """
    with recording_file(path, layout=_layout(scene)) as stream:
        _log_static(stream, scene)
        for number, step in enumerate(scene.steps):
            stream.set_time(TIMELINE, sequence=number)
            _log_step(stream, scene, step)
    return Path(path)


class LiveRecording:
    """A viewer that is shown one step after the other. Nothing here waits for it longer than rerun does."""

    def __init__(self, url: str, scene: Scene) -> None:
        import rerun as rr

        self._scene, self._number = scene, 0
        self._stream = rr.RecordingStream("spherecal")
        self._stream.connect_grpc(url, default_blueprint=_layout(scene))
        _log_static(self._stream, scene)

    def show(self, step: Step, *, is_new: bool) -> None:
        """Show a step; as the next of the timeline, or as the robot under way to it."""
        self._number += is_new
        self._stream.set_time(TIMELINE, sequence=self._number)
        if is_new:
            _log_step(self._stream, self._scene, step)
        else:
            _log_robot(self._stream, self._scene, step)


def _log_static(stream: rr.RecordingStream, scene: Scene) -> None:
    import rerun as rr

    stream.log("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(0.15), static=True)
    for title, text in scene.texts.items():
        stream.log(f"texts/{_entity(title)}", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    for sphere in scene.spheres:
        stream.log(f"base/spheres/{_entity(sphere.name)}", _wire_sphere(sphere), static=True)
        _log_clouds_of(stream, scene, sphere)
    if scene.stitched_in_base_mm is not None:
        stream.log("base/stitched", _points(scene.stitched_in_base_mm, STITCHED_COLOUR, 10 * _POINTS_OF_ALL_STEPS), static=True)
    for capsule_link, capsules in _by_link(scene.shape).items():
        stream.log(f"base/robot/link{capsule_link}/body", _bodies(capsules), static=True)
    log_surroundings(stream, scene)
    for name, colour in _curve_colours(scene).items():
        stream.log(f"curves/{_entity(name)}", rr.SeriesLines(colors=colour, names=name, widths=1.5), static=True)
        stream.log(f"curves/{_entity(name)}", rr.SeriesPoints(colors=colour, names=name, marker_sizes=3.0), static=True)


def _log_clouds_of(stream: rr.RecordingStream, scene: Scene, sphere: SphereMark) -> None:
    """All shots' points on one sphere, coloured by their error on one scale: the picture of what calibration does."""
    scale = error_scale_mm(scene)
    for side, cloud in (("before", sphere.before), ("after", sphere.after)):
        if cloud is not None:
            stream.log(f"base/all_shots/{_entity(sphere.name)}/{side}", _coloured(cloud, scale), static=True)


def error_scale_mm(scene: Scene) -> float:
    """Radial error of the strongest colour: exceeded by 5 % of the points, before where there is a before."""
    clouds = [s.before for s in scene.spheres if s.before] or [s.after for s in scene.spheres if s.after]
    errors = np.concatenate([np.abs(cloud.radial_error_mm) for cloud in clouds]) if clouds else np.zeros(0)
    return max(float(np.quantile(errors, 0.95)), 1e-3) if errors.size else 1.0


def _log_step(stream: rr.RecordingStream, scene: Scene, step: Step) -> None:
    import rerun as rr

    _log_robot(stream, scene, step)
    stream.log("base/camera", _transform(step.base_from_camera), rr.TransformAxes3D(0.06))
    if scene.field_of_view_deg is not None:
        stream.log("base/camera", _frustum(scene.field_of_view_deg, scene.depth_mm))
    stream.log("base/shot/before", _points(step.before_in_base_mm, BEFORE_COLOUR, _POINTS_PER_STEP))
    stream.log("base/shot/after", _points(step.after_in_base_mm, AFTER_COLOUR, _POINTS_PER_STEP))
    stream.log("texts/shot", rr.TextLog(step.label, level=rr.TextLogLevel.INFO))
    for name, value in step.curves.items():
        if np.isfinite(value):
            stream.log(f"curves/{_entity(name)}", rr.Scalars(value))


def _log_robot(stream: rr.RecordingStream, scene: Scene, step: Step) -> None:
    import rerun as rr

    for i, frame in enumerate(step.base_from_links):
        axes = 0.12 if i == len(step.base_from_links) - 1 else 0.06
        stream.log(f"base/robot/link{i}", _transform(frame), rr.TransformAxes3D(axes))
    if not scene.shape:
        corners = _arm_line_mm(step)
        stream.log("base/robot/arm", rr.LineStrips3D([corners * _MM], colors=ROBOT_COLOUR, radii=0.012))
        stream.log("base/robot/axes", rr.Points3D(corners * _MM, colors=ROBOT_COLOUR, radii=0.022))


def _arm_line_mm(step: Step) -> FloatArray:
    """Corners of the line from the base through the link origins to the camera; from the flange on where links are unknown.

    Along a link the way first follows the previous axis and then the common normal, as the arm itself does; a straight
    line between two origins would cut the corner.
    """
    origins = step.base_from_links[:, :3, 3]
    if len(origins) == 1:
        return np.array([origins[0], step.base_from_camera[:3, 3]])
    corners = [np.zeros(3)]
    for frame, origin in zip(step.base_from_links, origins, strict=True):
        along_axis = float((origin - corners[-1]) @ frame[:3, 2])
        corners += [origin - along_axis * frame[:3, 2], origin]
    return np.array([*corners, step.base_from_camera[:3, 3]])


def _frustum(field_of_view_deg: tuple[float, float], depth_mm: float) -> Any:
    import rerun as rr

    half = np.tan(np.deg2rad(np.asarray(field_of_view_deg)) / 2)
    size = 1000.0 * half / half.max()
    focal = size / 2 / half
    return rr.Pinhole(focal_length=focal, resolution=size, image_plane_distance=depth_mm * _MM, color=(120, 180, 255), line_width=0.0015)


def _wire_sphere(sphere: SphereMark) -> Any:
    import rerun as rr

    centre, radius = sphere.centre_in_base_mm * _MM, sphere.radius_mm * _MM
    return rr.Ellipsoids3D(centers=[centre], radii=[radius], colors=(220, 220, 220), labels=[sphere.name], line_radii=_UI_POINT / 4)


def _bodies(capsules: Sequence[Capsule]) -> Any:
    import rerun as rr

    start, end = (np.array([getattr(c, side) for c in capsules]) * _MM for side in ("start_mm", "end_mm"))
    return rr.Capsules3D(
        lengths=np.linalg.norm(end - start, axis=1),
        radii=np.array([c.radius_mm for c in capsules]) * _MM,
        translations=start,
        quaternions=[_quaternion_xyzw_from_z(d) for d in end - start],
        colors=ROBOT_COLOUR,
        fill_mode=rr.components.FillMode.Solid,
    )


def _quaternion_xyzw_from_z(direction: FloatArray) -> Any:
    """The shortest rotation of the z axis into a direction (half-vector form; half a turn about x for -z)."""
    import rerun as rr

    length = float(np.linalg.norm(direction))
    unit = direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    w = 1.0 + unit[2]
    xyzw = np.array([1.0, 0, 0, 0]) if w < 1e-9 else np.array([-unit[1], unit[0], 0.0, w])
    return rr.Quaternion(xyzw=xyzw / np.linalg.norm(xyzw))


def _transform(target_from_source: FloatArray) -> Any:
    import rerun as rr

    return rr.Transform3D(translation=target_from_source[:3, 3] * _MM, mat3x3=target_from_source[:3, :3])


def _points(points_mm: FloatArray, colour: tuple[int, int, int], n_most: int) -> Any:
    import rerun as rr

    return rr.Points3D((_thinned(points_mm, n_most) * _MM).astype(np.float32), colors=colour, radii=_UI_POINT)


def _coloured(cloud: SphereCloud, scale_mm: float) -> Any:
    import rerun as rr

    stride = max(1, -(-len(cloud.points_in_base_mm) // _POINTS_OF_ALL_STEPS))
    points, error = cloud.points_in_base_mm[::stride], cloud.radial_error_mm[::stride]
    return rr.Points3D((points * _MM).astype(np.float32), colors=_diverging(error / scale_mm), radii=1.5 * _UI_POINT)


def _diverging(share: FloatArray) -> NDArray[np.uint8]:
    """Colours (n, 3) of shares (n,): -1 blue, 0 light grey, 1 red."""
    strength = np.clip(np.abs(share), 0.0, 1.0)[:, None]
    ends = np.where((share < 0)[:, None], np.array([[33.0, 102, 230]]), np.array([[230.0, 40, 30]]))
    return np.asarray((1 - strength) * np.array([[225.0, 225, 225]]) + strength * ends, dtype=np.uint8)


def _thinned(points_mm: FloatArray, n_most: int) -> FloatArray:
    """Finite rows of points (..., 3), every k-th so that at most `n_most` are left."""
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, -(-len(points) // n_most))]


def _by_link(shape: Iterable[Capsule]) -> dict[int, list[Capsule]]:
    result: dict[int, list[Capsule]] = {}
    for capsule in shape:
        result.setdefault(capsule.link, []).append(capsule)
    return result


def _curve_colours(scene: Scene) -> dict[str, tuple[int, int, int]]:
    others = [(160, 120, 220), (120, 190, 90), (200, 90, 130)]
    names = dict.fromkeys(name for step in scene.steps for name in step.curves)
    sides = {"before": BEFORE_COLOUR, "after": AFTER_COLOUR}
    return {name: sides.get(name.split(":")[0], others[i % len(others)]) for i, name in enumerate(names)}


def _entity(name: str) -> str:
    """A name as one part of an entity path."""
    return "".join(c if c.isalnum() else "_" for c in name) or "_"


def _layout(scene: Scene) -> Any:
    """The cell with the moving robot on the left; one sphere close up, curves and texts on the right."""
    import rerun.blueprint as rrb

    cell = rrb.Spatial3DView(origin="base", contents=["+ base/**", "- base/all_shots/**"], name="cell", eye_controls=_eye(scene))
    texts = [rrb.TextDocumentView(origin=f"texts/{_entity(title)}", name=title) for title in scene.texts]
    close = [_close_view(scene, sphere) for sphere in scene.spheres if _sides(sphere)]
    curves = rrb.TimeSeriesView(origin="curves", name="residuals in mm over the poses", plot_legend=rrb.PlotLegend(corner="RightTop"))
    log = rrb.TextLogView(origin="texts/shot", name="shots")
    has_curves = not scene.steps or any(step.curves for step in scene.steps)
    right: list[Any] = [rrb.Tabs(*texts, log), *([rrb.Tabs(*close)] if close else []), *([curves] if has_curves else [])]
    shares = [2.0, *([2.2] if close else []), *([1.6] if has_curves else [])]
    columns = rrb.Horizontal(cell, rrb.Vertical(*right, row_shares=shares), column_shares=[1.5, 1.0])
    return rrb.Blueprint(
        columns,
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _close_view(scene: Scene, sphere: SphereMark) -> Any:
    import rerun.blueprint as rrb

    views = [_side_view(sphere, side, f"{sphere.name} {side}, colour ±{error_scale_mm(scene):.2g} mm") for side in _sides(sphere)]
    return rrb.Horizontal(*views, name=f"sphere {sphere.name}")


def _sides(sphere: SphereMark) -> list[str]:
    return [side for side, cloud in (("before", sphere.before), ("after", sphere.after)) if cloud is not None]


def _side_view(sphere: SphereMark, side: str, name: str) -> Any:
    import rerun.blueprint as rrb

    target = sphere.centre_in_base_mm * _MM
    position = target + sphere.radius_mm * _MM * np.array([1.4, -1.4, 2.2])
    eye = rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1))
    return rrb.Spatial3DView(
        origin="base", contents=[f"+ base/all_shots/{_entity(sphere.name)}/{side}"], name=name, line_grid=False, eye_controls=eye
    )


def _eye(scene: Scene) -> Any:
    """A look from the front and above at the robot and its spheres."""
    import rerun.blueprint as rrb

    places = [s.centre_in_base_mm for s in scene.spheres] + [step.base_from_camera[:3, 3] for step in scene.steps[:50]]
    if not places:
        return None
    middle = np.mean(places, axis=0)
    target = 0.55 * middle + np.array([0, 0, 0.4 * np.linalg.norm(middle)])
    away = np.array([middle[0], middle[1], 0.0])
    reach = max(float(np.linalg.norm(away)), 400.0)
    forward = away / max(float(np.linalg.norm(away)), 1.0)
    side = np.array([forward[1], -forward[0], 0.0])
    position = target + reach * (1.2 * forward + 2.1 * side) + np.array([0, 0, 0.7 * reach])
    return rrb.EyeControls3D(position=position * _MM, look_target=target * _MM, eye_up=(0, 0, 1))
