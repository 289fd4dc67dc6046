"""The distributions that spherecal needs, as installed here."""

from __future__ import annotations

import re
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

from tests.support.source import ROOT

COPYLEFT = re.compile(r"\b(A|L)?GPL|GNU (Lesser |Affero )?General Public", re.IGNORECASE)


def canonical(name: str) -> str:
    """A distribution's name as the index compares names."""
    return re.sub(r"[-_.]+", "-", name).lower()


def direct_names(*extras: str) -> set[str]:
    """What spherecal itself requires on this platform, with extras."""
    return {canonical(requirement.name) for requirement in _required_by(distribution("spherecal"), {"", *extras})}


def closure(*extras: str) -> dict[str, Distribution]:
    """Every distribution that an installation of spherecal brings, by canonical name."""
    found: dict[str, Distribution] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [Requirement(f"spherecal[{','.join(extras)}]")]
    while waiting:
        requirement = waiting.pop()
        name, wanted = canonical(requirement.name), frozenset(requirement.extras)
        if (name, wanted) not in seen:
            seen.add((name, wanted))
            found[name] = distribution(name)
            waiting += _required_by(found[name], {"", *wanted})
    return found


def _required_by(dist: Distribution, extras: set[str]) -> list[Requirement]:
    requirements = [Requirement(text) for text in dist.requires or []]
    return [r for r in requirements if r.marker is None or any(r.marker.evaluate({"extra": extra}) for extra in extras)]


def licence_words(dist: Distribution) -> str:
    """What a distribution's metadata says of its licence: expression, first line of the text, classifiers."""
    metadata = dist.metadata
    fields = [metadata[key].strip().partition("\n")[0] for key in ("License-Expression", "License") if key in metadata]
    classifiers = [text for text in metadata.get_all("Classifier") or [] if text.startswith("License")]
    return "; ".join(part for part in (*fields, *classifiers) if part)


def third_party_text() -> str:
    """THIRD_PARTY.md."""
    return Path(ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
