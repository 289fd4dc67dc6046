"""`spherecal check`: has anything changed since the calibration, and what (docs/check.md)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from acquire.cell import Cell, cell_of_session, robot_model_of
from calibrate.check_design import clarity
from calibrate.drift_causes import CAMERA, HAND_EYE, SHOT, SPHERE, Diagnosis, causes_of, diagnose, named
from calibrate.drift_pairs import Together, two_causes
from calibrate.observations import Observations, RejectedShot, SphereShot
from calibrate.quick_check import CheckResiduals, check_residuals, known_state
from calibrate.result import Calibration
from calibrate.second_look import see_sessions
from calibrate.temperature import artefact_when_seen
from drivers.errors import DataError
from drivers.files.session import Session
from measure.decision import Verdict
from measure.placing import check_fits
from measure.quick.since import SinceEarlier, since_earlier, together_json, told_causes
from measure.verify import verify_observations
from measure.verify_result import SessionName, VerifyResult

LEAST_SHOTS = 5
LEAST_CLARITY = 3.0
"""A change of the stated size must stand out of the shots' noise by so many standard deviations, or a check proves nothing."""

ADVICE: Mapping[str, str] = {
    HAND_EYE: "Look at the camera's mount and its screws; then calibrate anew, or solve the hand-eye anew: check --resolve.",
    CAMERA: "Let the camera warm up and look at its lens; if the next check says the same, calibrate anew.",
    SPHERE: "See whether the stand was moved; if it was, this says nothing of robot and camera: calibrate anew to know its place.",
    SHOT: "One shot stands alone: look at its scan, and take the check again.",
}
_ADVICE_FOR_AXES = (
    "An axis reads otherwise than before (encoder, belt, a new zero): see the robot's records; then calibrate anew, or check --resolve."
)


@dataclass(frozen=True, slots=True)
class CheckShot:
    """One shot against the calibration."""

    session: str
    index: int
    sphere: str
    off_mm: float
    """Distance of its centre from where the calibration has the sphere."""
    expected_mm: float
    """Root mean square of that distance where nothing changed."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckResult:
    """What a quick check found."""

    calibration_id: str
    shots: tuple[CheckShot, ...]
    rms_mm: float
    expected_rms_mm: float
    diagnosis: Diagnosis
    named: tuple[str, ...]
    """What has changed, all that cannot be told apart together; nothing where nothing changed."""
    clarity: Mapping[str, tuple[float, float]]
    """For each cause how far a change of the stated size stands out of the noise, and apart from other causes (sigmas)."""
    figures: VerifyResult
    """The figures of a verification, on these few shots."""
    verdict: Verdict
    reasons: tuple[str, ...]
    seconds: float
    together: Together | None = None
    """More than one thing that changed (`named` is then at best one of them); None where one cause explains the shots well enough."""
    since: SinceEarlier | None = None
    """Against an earlier check; None where none was given."""
    taken_utc: str | None = None
    """When its last shot was taken."""
    sphere_shots: tuple[SphereShot, ...] = field(default=(), repr=False)

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints: the keys of a verification, and what the check adds."""
        told = self.figures.to_json_dict()
        kept = ("n_shots", "used", "rejected", "centre_rms_mm", "centre_max_mm", "radial_rms_mm", "lengths", "spheres", "calibration", "sessions")
        names = {s["digest"]: s["name"] for s in told["sessions"]} if isinstance(told["sessions"], list) else {}
        return {
            **{key: told[key] for key in kept},
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "changed": self.diagnosis.changed,
            "named": list(self.named),
            "together": together_json(self.together),
            "since": None if self.since is None else self.since.to_json_dict(),
            "p_value": self.diagnosis.p_value,
            "chi_square": self.diagnosis.chi_square,
            "freedom": self.diagnosis.freedom,
            "rms_mm": self.rms_mm,
            "expected_rms_mm": self.expected_rms_mm,
            "causes": [
                {
                    "cause": e.name,
                    "probability": e.probability,
                    "chi_square_explained": e.chi_square,
                    "freedom": e.freedom,
                    "amplitudes": _pairs_json(e.amplitudes),
                    "alone": _pairs_json(e.alone),
                }
                for e in self.diagnosis.explanations
            ],
            "clarity": {name: {"seen_sigmas": seen, "apart_sigmas": apart} for name, (seen, apart) in self.clarity.items()},
            "shots": [
                {"session": names.get(s.session, s.session), "index": s.index, "sphere": s.sphere, "off_mm": s.off_mm, "expected_mm": s.expected_mm}
                for s in self.shots
            ],
            "taken_utc": self.taken_utc,
            "seconds": self.seconds,
        }


def check(calibration: Calibration, sessions: Sequence[Session], since: Session | None = None) -> CheckResult:
    """Compare a few shots with their calibration.

    Args:
        calibration: of the spheres that the shots show.
        sessions: at least one.
        since: an earlier check at the same poses, to compare with.

    Raises:
        DataError: no shot shows a sphere or repeats a pose of the earlier check; a sphere that the calibration has not seen, its own
            shots, or a line profile.
        FileError: a session is broken.
    """
    began = time.perf_counter()
    cells = [cell_of_session(session) for session in sessions]
    seen = [_seen(calibration, session, cell) for session, cell in zip(sessions, cells, strict=True)]
    rejected = tuple(shot for part in seen for shot in part.rejected)
    shots = sorted((shot for part in seen for shot in part.shots), key=lambda shot: shot.key)
    if not shots:
        why = f"; the first refusal was: {rejected[0].reason}" if rejected else ""
        raise DataError(f"none of {len(rejected)} shots shows a sphere{why}", file=sessions[0].folder, remedy="Capture shots of the spheres.")
    artefact = artefact_when_seen({n: s for c in cells for n, s in c.spheres.items()}, list(cells[0].lengths), sessions)
    cell = cells[0].model_copy(update={"spheres": artefact.spheres, "lengths": artefact.lengths})
    result = check_shots(calibration, shots, rejected, cell)
    if since is not None:
        earlier = _seen(calibration, since, cell_of_session(since)).shots
        result = _with_since(result, since_earlier(calibration, since.folder.name, earlier, shots))
    named_sessions = tuple(SessionName(session.folder.name, session.digest) for session in sessions)
    return replace(result, figures=replace(result.figures, sessions=named_sessions), seconds=time.perf_counter() - began)


def check_shots(calibration: Calibration, shots: Sequence[SphereShot], rejected: Sequence[RejectedShot], cell: Cell) -> CheckResult:
    """The same on shots that are in memory already."""
    residuals = check_residuals(calibration, shots)
    causes = causes_of(residuals, known_state(calibration, residuals.problem.n_scans), tuple(calibration.sphere_centres_in_base_mm))
    diagnosis = diagnose(residuals, causes)
    told = named(diagnosis, 0 if calibration.model is None else calibration.model.n_joints)
    together = two_causes(residuals, causes, diagnosis)
    clear = clarity(residuals, causes)
    verdict, reasons = _judged(diagnosis, told, together, clear, len(shots))
    figures = verify_observations(calibration, Observations(tuple(shots), tuple(rejected)), cell, limits=calibration.limits)
    times = [shot.time_utc for shot in shots if shot.time_utc is not None]
    return CheckResult(
        calibration_id=calibration.id,
        shots=_told_shots(residuals, shots),
        rms_mm=residuals.rms_mm,
        expected_rms_mm=residuals.expected_rms_mm,
        diagnosis=diagnosis,
        named=told,
        clarity=clear,
        figures=figures,
        verdict=verdict,
        reasons=reasons,
        seconds=0.0,
        together=together,
        taken_utc=max(times) if times else None,
        sphere_shots=tuple(shots),
    )


def _seen(calibration: Calibration, session: Session, cell: Cell) -> Observations:
    check_fits(calibration, session, cell)
    _refuse_training(calibration, [session])
    return see_sessions([session], cell=cell, model=robot_model_of(cell, session))


def _with_since(result: CheckResult, since: SinceEarlier) -> CheckResult:
    """A change since an earlier check is one, even where the calibration's own uncertainty hides it."""
    changed = since.diagnosis.changed
    remedy = (advice(since.named),) if changed and not result.diagnosis.changed else ()
    return replace(result, since=since, verdict="reject" if changed else result.verdict, reasons=(*result.reasons, since.reason, *remedy))


def _judged(
    diagnosis: Diagnosis, told: tuple[str, ...], together: Together | None, clear: Mapping[str, tuple[float, float]], n_shots: int
) -> tuple[Verdict, tuple[str, ...]]:
    if diagnosis.changed:
        likeliest = diagnosis.explanations[0]
        what = f"changed since the calibration: {told_causes(told, together)}"
        if together is not None:
            return "reject", (what, *dict.fromkeys(advice((name,)) for name in together.pairs[0].causes))
        sizes = ", ".join(_amount(name, value, sigma) for name, (value, sigma) in likeliest.amplitudes.items())
        return "reject", (what, f"by {sizes}", advice(told))
    blind = [name for name, (seen, _) in clear.items() if seen < LEAST_CLARITY]
    if n_shots < LEAST_SHOTS:
        return "not_proven", (f"{n_shots} shots are fewer than the {LEAST_SHOTS} that a check needs",)
    if blind:
        why = f"nothing seems changed, but these poses would hardly show a change of: {', '.join(blind)}"
        return "not_proven", (f"{why} (plan --for check chooses better ones)",)
    return "conform", ("nothing has changed that these shots could show",)


def advice(told: Sequence[str]) -> str:
    """What to do about a named change."""
    return ADVICE.get(told[0], _ADVICE_FOR_AXES)


def _amount(name: str, value: float, sigma: float) -> str:
    if name.endswith("_rad"):
        return f"{name.removesuffix('_rad')} {1e3 * value:+.3f} +- {1e3 * sigma:.3f} mrad"
    return f"{name.removesuffix('_mm')} {value:+.3f} +- {sigma:.3f} mm"


def _pairs_json(pairs: Mapping[str, tuple[float, float]]) -> dict[str, object]:
    return {name: {"value": value, "standard_uncertainty": sigma} for name, (value, sigma) in pairs.items()}


def _told_shots(residuals: CheckResiduals, shots: Sequence[SphereShot]) -> tuple[CheckShot, ...]:
    off = np.linalg.norm(residuals.residual_mm, axis=1)
    expected = np.sqrt(np.diagonal(residuals.covariance_mm2).reshape(-1, 3).sum(axis=1))
    return tuple(CheckShot(s.session, s.index, s.sphere, float(o), float(e)) for s, o, e in zip(shots, off, expected, strict=True))


def _refuse_training(calibration: Calibration, sessions: Sequence[Session]) -> None:
    known = {shot.scan_sha256 for shot in calibration.shots}
    for session in sessions:
        for shot in session.shots:
            if shot.sha256 in known:
                message = "the calibration was made from this shot, so that it shows no change since"
                raise DataError(message, file=session.folder, where=f"shot {shot.index}", remedy="Check on shots taken afterwards.")
