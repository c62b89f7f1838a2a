"""Looks: what a look says is what the shader is compiled with, and the avatar of a look says whose it is."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import load_body
from trilane.errors import BadInputError
from trilane.training import subject
from trilane.training.clothing.layers import GARMENTS
from trilane.training.clothing.looks import DEFAULT, HIKER, LOOKS, find_landmarks, look_named, look_of
from trilane.training.surface import body_arrays

BODY = bundle_folder("default") / "body.npz"


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_a_look_is_complete(look: Any) -> None:
    """The same colours for all, each within sRGB; garments that there are; no more coefficients than a body has."""
    assert set(look.colours) == set(DEFAULT.colours) and set(look.garments) <= set(GARMENTS)
    assert all(0 <= share <= 1 for colour in look.colours.values() for share in colour)
    assert len(look.betas) <= 10


def test_where_legs_end_is_measured_from_the_joint_of_the_look() -> None:
    """Over the ankle: 20 mm for trousers that end 20 mm over it, the shin and 55 mm for shorts."""
    arrays = body_arrays(load_body(BODY).shape())
    landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
    assert DEFAULT.definitions(landmarks)["LEGS_END"] == "(0.02)"
    shin = arrays.joints[4, 1] - arrays.joints[7, 1]
    found = HIKER.definitions(landmarks)
    assert float(found["LEGS_END"].strip("()")) == pytest.approx(shin + 0.055, abs=1e-12) and shin > 0.3
    assert (found["SLEEVE_END"], found["SKIN"]) == ("(1.8)", "vec3(0.53, 0.35, 0.25)")


def test_an_avatar_says_whose_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(subject, "SampleRenderer", lambda shaped, look, **_: made.append((shaped, look)))
    monkeypatch.setattr(subject, "load_body", {Path("b"): SimpleNamespace(shape=lambda betas: betas)}.__getitem__)
    hiker = subject.clothed_subject(Path("b"), 2, "hiker")
    assert hiker.person == subject.Person(Path("b"), HIKER.betas) and made == [(HIKER.betas, HIKER)]
    assert look_of(hiker.facts) is HIKER and hiker.source.args[:2] == (Path("b"), "hiker")  # type: ignore[attr-defined]
    assert look_of(subject.clothed_subject(Path("b"), 2).facts) is DEFAULT
    assert look_of({}) is DEFAULT, "avatars that were trained before there were looks"
    with pytest.raises(BadInputError, match="expected one of default, hiker"):
        look_named("nobody")
