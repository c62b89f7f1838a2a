"""Scene files: defaults and limits typed a second time, defects named by file and key, paths from the file's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from trilane.errors import BadInputError
from trilane.scene.schema import (
    Scene,
    find_scene,
    load_scene,
    located,
    scene_from,
    scene_names,
)
from trilane.units import AVATARS

WRONG = {
    "size = '100'": ("size", "found side 100", "a multiple of 32"),
    "size = 'wide'": ("size", "found 'wide'", "expected HEIGHTxWIDTH such as 256x256, or auto"),
    "size = 256": ("size", "found 256", "expected text in quotes"),
    "memory_mb = 1.5": ("memory_mb", "found 1.5", "expected a whole number"),
    "[camera]\nfov = 30": ("camera.fov", "an unknown key", "did you mean 'fov_y_deg'?"),
    "fps = nan": ("fps", "found nan", "a finite number"),
    "[output]\nwidth = 641": ("output.width", "found 641", "a multiple of 2"),
    "[camera]\nnear_m = 1e-9": ("camera", "far_m 100", "at most 1e+06 times near_m"),
    "[camera]\nmetres_per_unit = 1": (
        'camera: found metres_per_unit = 1.0 with source = "builtin:orbit"',
        "expected metres_per_unit with a file alone",
        "remove it, or name the file in camera.source",
    ),
    "[camera]\nsource = 'builtin:far'\naxes = 'forward-left-up'": ("camera: found axes", "expected axes with a file"),
    "[camera]\nup_axis = 'z'": ("camera: found up_axis", "remove it"),
    "[camera]\nrate_hz = 30": ("camera: found rate_hz", "remove it"),
    "[camera]\nformat = 'tum'": ("camera: found format", "remove it"),
    "[[avatars]]\nposition = [1e5, 0, 0]": ("avatars.0.position.0", "found 100000.0", "less than or equal to 10000"),
    "error_budget_px = true": ("error_budget_px", "found True", "a number, without quotes"),
    "error_budget_px = '0.5'": ("error_budget_px", "found '0.5'", "a number, without quotes"),
    "hud = 'yes'": ("hud", "found 'yes'", "true or false, without quotes"),
    "hud = 1": ("hud", "found 1", "true or false, without quotes"),
    "most_side = 64.0": ("most_side", "found 64.0", "a whole number, without quotes or decimal point"),
    "frames = true": ("frames", "found True", "a whole number"),
    "[[avatars]]\nposition = [0, '1', 0]": ("avatars.0.position.1", "found '1'", "a number"),
    "[[planes]]\nnormal = [0, true, 0]": ("planes.0.normal.1", "found True", "a number"),
    "frames 3": ("", "no valid TOML", "line 1"),
}


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_named_by_file_and_key(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(BadInputError) as raised:
        load_scene(path)
    key, *parts = WRONG[text]
    assert str(raised.value).startswith(f"{path}: {key}")
    assert "\n" not in str(raised.value)
    for part in parts:
        assert part in str(raised.value)


@pytest.mark.parametrize(
    ("budget", "said"), [("0", "greater than 0; numbers are rounded"), ("inf", "a finite number"), ("101", "to 100")]
)
def test_why_there_is_no_budget_of_nothing_is_said_of_nothing_else(tmp_path: Path, budget: str, said: str) -> None:
    with pytest.raises(BadInputError) as raised:
        load_scene(write(tmp_path, f"error_budget_px = {budget}"))
    assert said in str(raised.value)
    assert ("rounded" in str(raised.value)) is (budget == "0")


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 5000])
def test_what_is_too_long_for_toml_is_refused(tmp_path: Path, value: str) -> None:
    with pytest.raises(BadInputError, match="no valid TOML"):
        load_scene(write(tmp_path, f"frames = {value}"))


def test_paths_start_at_the_scene_file(tmp_path: Path) -> None:
    text = "background='b.png'\n[camera]\nsource='c.txt'\n[[avatars]]\nmotion='m.bvh'\n[[avatars]]\nbundle='/x/y'\n"
    scene = scene_from("scene", load_scene(write(tmp_path, text)))
    assert scene.name == "scene"
    assert scene.background == str(tmp_path / "b.png")
    assert scene.camera.source == str(tmp_path / "c.txt")
    assert [avatar.motion for avatar in scene.avatars] == [str(tmp_path / "m.bvh"), "builtin:walk-wave-turn"]
    assert [avatar.bundle for avatar in scene.avatars] == ["default", "/x/y"]


def test_every_scene_that_comes_along_is_valid() -> None:
    assert "default" in scene_names()
    for name in scene_names():
        assert scene_from(name, load_scene(find_scene(name))).name == name


def test_the_default_scene_says_what_the_schema_says() -> None:
    assert scene_from("default", load_scene(find_scene("default"))) == Scene(name="default")


def test_whole_numbers_and_lists_are_read_for_others(tmp_path: Path) -> None:
    """TOML tells 1 from 1.0 and knows no tuples; a scene that was written as JSON is read again."""
    lines = ["fps = 24", "error_budget_px = 1", "[camera]", "near_m = 1", "[[planes]]", "centre = [1, 2, 3]"]
    scene = scene_from("here", load_scene(write(tmp_path, "\n".join([*lines, "[[avatars]]", "position = [0, 1, 2]"]))))
    numbers = (scene.fps, scene.error_budget_px, scene.camera.near_m, *scene.planes[0].centre)
    assert numbers == (24, 1, 1, 1, 2, 3) and {type(number) for number in numbers} == {float}
    assert scene.avatars[0].position == (0.0, 1.0, 2.0)
    assert Scene.model_validate(scene.model_dump(mode="json")) == scene


def test_a_direction_of_no_length_is_named() -> None:
    with pytest.raises(BadInputError) as raised:
        scene_from("here", {"planes": [{"normal": [0, 0, 0]}]})
    assert str(raised.value) == "here: planes.0.normal: found (0.0, 0.0, 0.0), expected a direction"
    with pytest.raises(BadInputError) as raised:
        scene_from("here", {"camera": {"near_m": 2, "far_m": 2}})
    assert str(raised.value) == (
        "here: camera: found near_m 2 and far_m 2, expected near_m below far_m and far_m at most 1e+06 times near_m"
    )


CHARACTERS = "expected letters, digits, spaces, dots, hyphens and underscores"


SENTENCES: list[tuple[dict[str, Any], str]] = [
    (
        {"colour": 1},
        "colour: found an unknown key, expected a key of the scene schema; correct its spelling or remove it",
    ),
    (
        {"avatars": [{}, {"positon": [0, 0, 0]}]},
        "avatars.1.positon: found an unknown key, expected a key of the scene schema; did you mean 'position'?",
    ),
    ({"avatar": []}, "avatar: found an unknown key, expected a key of the scene schema; did you mean 'avatars'?"),
    (
        {"texture_filter": "mipmaps"},
        "texture_filter: found 'mipmaps', expected 'linear', 'mipmap' or 'anisotropic'; did you mean 'mipmap'?",
    ),
    (
        {"avatars": [{"ground": "frames"}]},
        "avatars.0.ground: found 'frames', expected 'auto', 'sequence', 'frame' or 'none'; did you mean 'frame'?",
    ),
    (
        {"avatars": [{"name": "anna"}, {}, {"name": "anna"}]},
        "avatars: found 'anna' as the name of avatars.0 and of avatars.2, expected a name of its own for each; "
        "change `name` of one of them",
    ),
    (
        {"error_budget_px": 0},
        "error_budget_px: found 0, expected greater than 0; numbers are rounded, so nothing is drawn without an error",
    ),
    ({"planes": [{"centre": [0, 0]}]}, "planes.0.centre.2: found nothing, expected a value; add the key"),
    ({"avatars": []}, "avatars: found [], expected at least 1 of them"),
    ({"avatars": [{}] * 9}, f"avatars: found {repr([{}] * 9)[:80]}, expected at most 8 of them"),
    ({"planes": 3}, "planes: found 3, expected a list"),
    ({"name": "a/b"}, "name: found 'a/b', " + CHARACTERS),
    ({"name": "/" * 79}, f"name: found '{'/' * 79}..., {CHARACTERS}"),
    ({"hud": None}, "hud: found None, expected true or false, without quotes"),
]


@pytest.mark.parametrize("case", range(len(SENTENCES)))
def test_what_is_wrong_with_a_scene_is_one_sentence(case: int) -> None:
    values, sentence = SENTENCES[case]
    with pytest.raises(BadInputError) as raised:
        scene_from("here", values)
    assert str(raised.value) == f"here: {sentence}"


def test_a_name_has_at_most_80_characters() -> None:
    assert scene_from("here", {"name": "a" * 80}).name == "a" * 80
    with pytest.raises(BadInputError, match="name"):
        scene_from("here", {"name": "a" * 81})


@pytest.mark.parametrize(
    ("stem", "name"), [("my+scene", "my-scene"), ("é 1.b", "é 1.b"), ("x²", "x-"), ("a" * 90, "a" * 80)]
)
def test_a_scene_without_a_name_is_named_after_its_file(tmp_path: Path, stem: str, name: str) -> None:
    path = tmp_path / f"{stem}.toml"
    path.write_text("fps = 20\n")
    assert load_scene(path)["name"] == name


def test_avatars_are_named_by_their_places_and_keep_their_names() -> None:
    """Also when a scene is checked again, as it is after the options of the command line were laid over it."""
    scene = scene_from("here", {"avatars": [{}, {"name": "anna"}, {}]})
    assert [avatar.name for avatar in scene.avatars] == ["avatar1", "anna", "avatar3"]
    assert scene_from("here", scene.model_dump(mode="json")) == scene


def test_places_of_files_and_names_that_are_built_in(tmp_path: Path) -> None:
    base = Path("/base")
    for name in ("room", *AVATARS, "builtin:orbit"):
        assert located(name, base) == name
    assert (located("a.png", base), located("/x/a.png", base)) == ("/base/a.png", "/x/a.png")
    with pytest.raises(BadInputError) as raised:
        located("", base)
    assert str(raised.value) == "name of a file: found nothing, expected a path, or the name of something built in"
    assert find_scene("x/y.toml") == Path("x/y.toml")
    assert find_scene("pair").name == "pair.toml" and find_scene("pair").is_file()
    with pytest.raises(BadInputError, match=r"; did you mean 'portrait'\?$"):
        find_scene("portait")
    with pytest.raises(BadInputError) as raised:
        find_scene("beach")
    names = "closeup, crowd, default, far, full-body, leave-and-return, pair, people, portrait, top-to-floor, walk-past"
    assert str(raised.value) == f"scene: found 'beach', expected a .toml file or one of {names}"
    path = tmp_path / "my.toml"
    path.write_text("[camera]\nnear_m = 0.1\n[[avatars]]\nheading_deg = 3.0\n")
    loaded = load_scene(path)
    assert loaded == {
        "name": "my", "background": "room", "camera": {"near_m": 0.1, "source": "builtin:orbit"},
        "avatars": [{"heading_deg": 3.0, "motion": "builtin:walk-wave-turn", "bundle": "default"}],
    }  # fmt: skip
    path.write_text("frames = 3\n")
    assert load_scene(path)["avatars"] == [{"motion": "builtin:walk-wave-turn", "bundle": "default"}]
    path.write_text("a = = 3\n")
    with pytest.raises(BadInputError, match=r"my.toml: found no valid TOML \(.*\), expected a scene file \(TOML\)"):
        load_scene(path)
