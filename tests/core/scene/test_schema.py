"""Scene files: defaults and limits typed a second time, defects named by file and key, paths from the file's folder."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from trilane.avatars.bundle import BUILT_IN
from trilane.errors import BadInputError
from trilane.scene.schema import (
    AvatarSpec,
    CameraSpec,
    OutputSpec,
    PlaneSpec,
    Scene,
    find_scene,
    load_scene,
    located,
    scene_from,
    scene_names,
)

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


def test_what_a_scene_leaves_out() -> None:
    assert Scene().model_dump() == {
        "name": "scene", "fps": 30.0, "frames": 300, "size": "256", "background": "room", "hud": False, "planes": (),
        "texture_filter": "linear", "plan": "planned", "error_budget_px": 0.5, "error_budget_db": None,
        "most_side": 512, "memory_mb": 512,
        "output": {"width": 640, "height": 480},
        "camera": {
            "source": "builtin:orbit", "format": "auto", "fov_y_deg": None, "up_axis": "auto",
            "metres_per_unit": None, "rate_hz": None, "near_m": 0.05, "far_m": 100.0, "place": "auto",
        },
        "avatars": ({
            "name": "avatar1", "bundle": "default", "motion": "builtin:walk-wave-turn",
            "position": (0.0, 0.0, 0.0), "heading_deg": 0.0,
            "up_axis": "auto", "units": "auto", "joint_map": {}, "start_s": 0.0, "end_s": None, "speed": 1.0,
            "loop": "auto", "ground": "auto",
        },),
    }  # fmt: skip
    assert PlaneSpec().model_dump() == {
        "centre": (0.0, 0.0, 0.0), "normal": (0.0, 1.0, 0.0), "width_m": 2.0, "depth_m": 2.0, "turn_deg": 0.0,
    }  # fmt: skip


#: Model, key, values that are fine, values that are not.
LIMITS: list[tuple[type, str, list[Any], list[Any]]] = [
    (OutputSpec, "width", [64, 4096], [62, 65, 4098]),
    (OutputSpec, "height", [64, 4096], [62, 65, 4098]),
    (
        AvatarSpec,
        "position",
        [(-1e4, 1e4, 0)],
        [(1.1e4, 0, 0), (0, -1.1e4, 0), (0, 0, 1.1e4), (0, math.nan, 0), (0, 0)],
    ),
    (AvatarSpec, "name", ["x" * 80, "a b.c-d_e"], ["", "x" * 81, "a/b", "a\n"]),
    (AvatarSpec, "heading_deg", [-3600, 3600], [-3601, 3601, math.nan]),
    (AvatarSpec, "up_axis", ["auto", "x", "y", "z", "-x", "-y", "-z"], ["+x", "Y"]),
    (AvatarSpec, "units", ["auto", "m", "cm", "in", "cmu"], ["mm"]),
    (AvatarSpec, "joint_map", [{}, {"left_hip": "Thigh L", "jaw": ""}], [{"left hip": "a"}, {"jaw": 1}]),
    (AvatarSpec, "start_s", [0, 1e6], [-0.1, 1.1e6, math.nan]),
    (AvatarSpec, "end_s", [0.1, 1e6, None], [0, 1.1e6, math.nan]),
    (AvatarSpec, "speed", [0.01, 100], [0, 101, math.nan]),
    (AvatarSpec, "loop", ["auto", "repeat", "back-and-forth", "hold"], ["bounce"]),
    (AvatarSpec, "ground", ["auto", "sequence", "frame", "none"], ["floor"]),
    (CameraSpec, "format", ["auto", "arkit", "colmap", "euroc", "kitti", "nerf", "record3d", "stray", "tum"], ["fbx"]),
    (CameraSpec, "up_axis", ["auto", "x", "y", "z", "-x", "-y", "-z"], ["+x", "Y"]),
    (CameraSpec, "metres_per_unit", [1e-9, 1e6, None], [0, -1, 1.1e6, math.nan]),
    (CameraSpec, "rate_hz", [1e-3, 1000, None], [0, 0.9e-3, 1001, math.nan]),
    (CameraSpec, "fov_y_deg", [1.1, 169.9, None], [1, 170, math.nan]),
    (CameraSpec, "near_m", [1e-4, 99.9], [0, 100, 0.99e-4, math.nan]),
    (CameraSpec, "far_m", [0.051, 5e4], [0, 0.05, 5.01e4, math.inf]),
    (CameraSpec, "place", ["auto", "none"], ["here"]),
    (PlaneSpec, "width_m", [0.001, 1000], [0, 1001, math.nan]),
    (PlaneSpec, "depth_m", [0.001, 1000], [0, 1001, math.nan]),
    (PlaneSpec, "turn_deg", [1e9], [math.nan, math.inf]),
    (PlaneSpec, "centre", [(1e9, 0, 0)], [(0, 0, math.inf), (0, 0)]),
    (PlaneSpec, "normal", [(0, 0, 1.1e-6), (0, 0, 0.9e6)], [(0, 0, 1e-6), (0, 0, 1e6), (0, 0, 0), (0, math.nan, 0)]),
    (Scene, "name", ["x" * 80, "a b.c-d_e"], ["", "x" * 81, "a/b", "a\n"]),
    (Scene, "fps", [0.001, 1000], [0, 1e-300, 0.0009, 1001, math.nan]),
    (Scene, "frames", [1, 10_000_000], [0, 10_000_001]),
    (Scene, "size", ["32", "64x96"], ["33", "64x95"]),
    (Scene, "planes", [({},) * 32], [({},) * 33]),
    (Scene, "texture_filter", ["linear", "mipmap", "anisotropic"], ["nearest"]),
    (Scene, "error_budget_px", [1e-9, 100], [0, -0.1, 100.1, math.inf]),
    (Scene, "avatars", [({},) * 8], [(), ({},) * 9]),
]


@pytest.mark.parametrize("case", range(len(LIMITS)))
def test_limits_of_the_schema_on_either_side(case: int) -> None:
    model, key, fine, wrong = LIMITS[case]
    for value in fine:
        model(**{key: value})
    for value in wrong:
        with pytest.raises(ValueError, match=key):
            model(**{key: value})
    with pytest.raises(ValueError, match="frozen"):
        setattr(model(), key, fine[0])
    with pytest.raises(ValueError, match="extra_forbidden"):
        model(colour=1)


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
        {"camera": {"sorce": "builtin:far"}},
        "camera.sorce: found an unknown key, expected a key of the scene schema; did you mean 'source'?",
    ),
    (
        {"avatars": [{}, {"positon": [0, 0, 0]}]},
        "avatars.1.positon: found an unknown key, expected a key of the scene schema; did you mean 'position'?",
    ),
    (
        {"planes": [{"widthm": 1}]},
        "planes.0.widthm: found an unknown key, expected a key of the scene schema; did you mean 'width_m'?",
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
        {"avatars": [{"name": "avatar2"}, {}]},
        "avatars: found 'avatar2' as the name of avatars.0 and of avatars.1, expected a name of its own for each; "
        "change `name` of one of them",
    ),
    (
        {"error_budget_px": 0},
        "error_budget_px: found 0, expected greater than 0; numbers are rounded, so nothing is drawn without an error",
    ),
    ({"planes": [{"centre": [0, 0]}]}, "planes.0.centre.2: found nothing, expected a value; add the key"),
    ({"avatars": []}, "avatars: found [], expected at least 1 of them"),
    ({"avatars": [{}] * 9}, f"avatars: found {repr([{}] * 9)[:80]}, expected at most 8 of them"),
    ({"camera": 3}, "camera: found 3, expected a table"),
    ({"planes": 3}, "planes: found 3, expected a list"),
    ({"name": "a/b"}, "name: found 'a/b', " + CHARACTERS),
    ({"name": "/" * 79}, f"name: found '{'/' * 79}..., {CHARACTERS}"),
    ({"frames": 0}, "frames: found 0, expected greater than or equal to 1"),
    ({"name": "/" * 78}, f"name: found '{'/' * 78}', {CHARACTERS}"),
    ({"hud": None}, "hud: found None, expected true or false, without quotes"),
]


@pytest.mark.parametrize("case", range(len(SENTENCES)))
def test_what_is_wrong_with_a_scene_is_one_sentence(case: int) -> None:
    values, sentence = SENTENCES[case]
    with pytest.raises(BadInputError) as raised:
        scene_from("here", values)
    assert str(raised.value) == f"here: {sentence}"


def test_avatars_are_named_by_their_places_and_keep_their_names() -> None:
    """Also when a scene is checked again, as it is after the options of the command line were laid over it."""
    scene = scene_from("here", {"avatars": [{}, {"name": "anna"}, {}]})
    assert [avatar.name for avatar in scene.avatars] == ["avatar1", "anna", "avatar3"]
    assert scene_from("here", scene.model_dump(mode="json")) == scene


def test_places_of_files_and_names_that_are_built_in(tmp_path: Path) -> None:
    base = Path("/base")
    for name in ("room", *BUILT_IN, "builtin:orbit"):
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
    names = "closeup, crowd, default, far, full-body, leave-and-return, pair, portrait, top-to-floor, walk-past"
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


MOTIONS = ("walk-wave-turn", "idle", "there-and-back")
WALK, STAND, GO = ({"bundle": "default", "motion": f"builtin:{name}"} for name in MOTIONS)


SCENES: dict[str, tuple[int, str, list[dict[str, Any]]]] = {
    "closeup": (240, "builtin:closeup", [STAND]),
    "default": (300, "builtin:orbit", [WALK]),
    "far": (300, "builtin:far", [WALK]),
    "pair": (300, "builtin:static", [
        {**WALK, "position": [-0.55, 0.0, 0.0], "heading_deg": 8.0},
        {**STAND, "position": [0.6, 0.0, 0.0], "heading_deg": -12.0},
    ]),
    "portrait": (240, "builtin:closeup", [STAND]),
    "full-body": (300, "builtin:static", [WALK]),
    "crowd": (300, "builtin:far", [
        {**WALK, "position": [0.0, 0.0, 0.3], "heading_deg": 0.0},
        {**STAND, "position": [-1.1, 0.0, -0.6], "heading_deg": 25.0},
        {**WALK, "position": [1.2, 0.0, -0.5], "heading_deg": -20.0},
        {**STAND, "position": [-2.1, 0.0, -1.4], "heading_deg": 40.0},
        {**STAND, "position": [2.2, 0.0, -1.3], "heading_deg": -30.0},
    ]),
    "walk-past": (450, "builtin:wayside", [GO]),
    "top-to-floor": (360, "builtin:top-to-floor", [STAND]),
    "leave-and-return": (450, "builtin:static", [{**GO, "position": [1.6, 0.0, -0.6], "heading_deg": 90.0}]),
}  # fmt: skip

#: Their size is chosen; in the others it is planned from what is on the screen.
CHOSEN = ("closeup", "default", "far", "pair")


def test_the_scenes_that_come_along_are_what_they_are() -> None:
    assert scene_names() == sorted(SCENES)
    for name, (frames, camera, avatars) in SCENES.items():
        output = {"width": 480, "height": 640} if name == "portrait" else {"width": 640, "height": 480}
        size = "256" if name in CHOSEN else "auto"
        most = {"most_side": 448} if name == "crowd" else {}
        assert re.match(r"# [A-Z].*\.\n", find_scene(name).read_text())
        assert tomllib.loads(find_scene(name).read_text()) == {
            "name": name, "fps": 30, "frames": frames, "size": size, "background": "room",
            "output": output, "camera": {"source": camera}, "avatars": avatars, **most,
        }  # fmt: skip
