"""Scene files: what is wrong is named by file and key, paths start at the file's folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane.errors import BadInputError
from trilane.scene.schema import Scene, find_scene, load_scene, scene_from, scene_names

WRONG = {
    "size = '100'": ("size", "found side 100", "a multiple of 32"),
    "size = 'wide'": ("size", "found 'wide'", "expected HEIGHTxWIDTH such as 256x256, or auto"),
    "size = 256": ("size", "found 256", "expected text in quotes"),
    "name = ''": ("name", "found ''", "expected at least one character"),
    "memory_mb = 1.5": ("memory_mb", "found 1.5", "expected a whole number"),
    "[camera]\nfov = 30": ("camera.fov", "an unknown key", "did you mean 'fov_y_deg'?"),
    "frames = 0": ("frames", "found 0", "greater than or equal to 1"),
    "fps = nan": ("fps", "found nan", "a finite number"),
    "colour = 1": ("colour", "an unknown key", "a key of the scene schema"),
    "avatars = []": ("avatars", "found []", "at least 1 of them"),
    "camera = 3": ("camera", "found 3", "a table"),
    "[output]\nwidth = 641": ("output.width", "found 641", "a multiple of 2"),
    "[[avatars]]\nup_axis = 'w'": ("avatars.0.up_axis", "found 'w'", "'-y' or '-z'"),
    "[camera]\nnear_m = 5\nfar_m = 1": ("camera", "near_m 5 and far_m 1", "expected near_m below far_m"),
    "[camera]\nnear_m = 1e-9": ("camera", "far_m 100", "at most 1e+06 times near_m"),
    "name = '../x'": ("name", "found '../x'"),
    "[[avatars]]\nposition = [1e5, 0, 0]": ("avatars.0.position.0", "found 100000.0", "less than or equal to 10000"),
    "most_side = 1": ("most_side", "found 1,", "a multiple of 32 from 32 to 4096"),
    "[output]\nwidth = 1": ("output.width", "found 1,", "a multiple of 2 from 64 to 4096"),
    "[output]\nheight = 62": ("output.height", "found 62,", "a multiple of 2 from 64 to 4096"),
    "[output]\nheight = 4098": ("output.height", "found 4098,", "a multiple of 2 from 64 to 4096"),
    "[[avatars]]\nposition = [-1e5, 0, 0]": ("avatars.0.position.0", "greater than or equal to -10000"),
    "error_budget_px = true": ("error_budget_px", "found True", "a number, without quotes"),
    "error_budget_px = '0.5'": ("error_budget_px", "found '0.5'", "a number, without quotes"),
    "hud = 'yes'": ("hud", "found 'yes'", "true or false, without quotes"),
    "hud = 1": ("hud", "found 1", "true or false, without quotes"),
    "most_side = 64.0": ("most_side", "found 64.0", "a whole number, without quotes or decimal point"),
    "frames = true": ("frames", "found True", "a whole number"),
    "[output]\nwidth = '640'": ("output.width", "found '640'", "a whole number"),
    "[camera]\nfov_y_deg = '30'": ("camera.fov_y_deg", "found '30'", "a number"),
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


@pytest.mark.parametrize(("content", "part"), [(b"", "an empty file"), (b"a\xff", "cannot be read as text")])
def test_a_file_that_is_no_text_is_refused(tmp_path: Path, content: bytes, part: str) -> None:
    (tmp_path / "scene.toml").write_bytes(content)
    with pytest.raises(BadInputError, match=part):
        load_scene(tmp_path / "scene.toml")


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


def test_a_scene_that_is_neither_file_nor_name_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"one of .*default"):
        find_scene("beach")


def test_whole_numbers_and_lists_are_read_for_others(tmp_path: Path) -> None:
    """TOML tells 1 from 1.0 and knows no tuples; a scene that was written as JSON is read again."""
    lines = ["fps = 24", "error_budget_px = 1", "[camera]", "near_m = 1", "[[planes]]", "centre = [1, 2, 3]"]
    scene = scene_from("here", load_scene(write(tmp_path, "\n".join([*lines, "[[avatars]]", "position = [0, 1, 2]"]))))
    numbers = (scene.fps, scene.error_budget_px, scene.camera.near_m, *scene.planes[0].centre)
    assert numbers == (24, 1, 1, 1, 2, 3) and {type(number) for number in numbers} == {float}
    assert scene.avatars[0].position == (0.0, 1.0, 2.0)
    assert Scene.model_validate(scene.model_dump(mode="json")) == scene
