"""Under which conditions a verification was made: when, how warm, against which certified values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from acquire.cell import CertifiedLength, Sphere
from drivers.files.session import Session


def conditions_of(sessions: Sequence[Session], spheres: Mapping[str, Sphere], lengths: Sequence[CertifiedLength]) -> tuple[tuple[str, str], ...]:
    """Name and text of each condition.

    Args:
        sessions: what was verified on.
        spheres: of the artefact, as large as they were when seen; those that no shot names are left out.
        lengths: between them, likewise.
    """
    shots = [shot for session in sessions for shot in session.shots if shot.status == "ok"]
    found = []
    times = sorted(shot.time_utc for shot in shots if shot.time_utc is not None)
    if times:
        found.append(("verification shots taken", f"{times[0]} to {times[-1]}"))
    readings: dict[str, list[float]] = {}
    for shot in shots:
        for sensor, celsius in shot.temperatures_c.items():
            readings.setdefault(sensor, []).append(celsius)
    found += [(f"verification temperature {name}", f"{min(c):.1f}°C to {max(c):.1f}°C") for name, c in sorted(readings.items())]
    if not readings:
        found.append(("verification temperatures", "none was recorded"))
    seen = {shot.sphere for shot in shots}
    for name, sphere in spheres.items():
        if name in seen:
            certificate = f", certificate: {sphere.certificate}" if sphere.certificate else ", no certificate named"
            found.append(
                (f"verification sphere {name}", f"diameter {sphere.diameter_mm:.4f} mm, U {sphere.expanded_uncertainty_mm:.4f} mm{certificate}")
            )
    for length in lengths:
        if set(length.between) <= seen:
            text = f"{length.length_mm:.4f} mm, U {length.expanded_uncertainty_mm:.4f} mm"
            found.append((f"verification length {'-'.join(length.between)}", text))
    return tuple(found)
