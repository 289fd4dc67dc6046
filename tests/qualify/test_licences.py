"""Licences of everything that an installation brings, on what is installed here (versions float, so not part of `make test`)."""

from __future__ import annotations

import pytest

from tests.support.dependencies import COPYLEFT, canonical, closure, licence_words, third_party_text

pytestmark = pytest.mark.qualify


def test_nothing_that_runs_is_under_a_strong_copyleft() -> None:
    bad = {name: licence_words(dist) for name, dist in closure().items() if COPYLEFT.search(licence_words(dist))}
    assert not bad


def test_every_distribution_says_its_licence() -> None:
    assert not [name for name, dist in closure("dev").items() if not licence_words(dist)]


def test_third_party_names_every_distribution() -> None:
    text = canonical(third_party_text())
    assert not [name for name in closure("dev") if name not in text and name != "spherecal"]
