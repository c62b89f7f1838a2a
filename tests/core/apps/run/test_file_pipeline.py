"""The pipeline that a pipeline file describes: cores, frames, slots and settings, by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from trilane.apps.run.run_file import asked_file, cores_of, frames_of, imports_of, pipeline_of, preload_of
from trilane.errors import BadInputError
from trilane.pipeline.file_graph import DEFAULT_FRAMES
from trilane.pipeline.pipeline_file import PipelineFile, read_pipeline
from trilane.stages.run_options import RunOptions

TEXT = """
[run]
fps = 20
[stages]
source = { block = "video", unit = "cpu", path = "pictures", size = "6x4" }
left   = { python = "own:left", unit = "gpu", in = "source", out = { a = "f32 3", b = "u8 5" } }
right  = { block = "busy", unit = "dsp", in = "source", load_ms = 1.0, every = 2 }
[stages.sink]
python = "own:sink"
unit = "cpu"
in = { x = "left.b", y = "left.a", z = "source", w = { from = "right", sync = "latest", max_age_ms = 40 } }
"""


def read(folder: Path, text: str = TEXT) -> PipelineFile:
    (folder / "pictures").mkdir(exist_ok=True)
    for number in range(7):
        Image.new("RGB", (8, 8)).save(folder / "pictures" / f"{number}.png")
    (folder / "file.toml").write_text(text)
    return read_pipeline(folder / "file.toml")


def test_streams_have_the_bytes_of_their_ports_and_inputs_their_places(tmp_path: Path) -> None:
    """A picture of 6 by 4 has 72 bytes, in lines of 64; a and b have a line each; a load writes a byte."""
    made = pipeline_of(read(tmp_path), tmp_path / "run")
    assert dict(zip(made.edge_names, [edge.payload_bytes for edge in made.edges], strict=True)) == {
        "source->left,right,sink": 128,
        "left->sink": 128,
        "right->sink": 64,
    }
    sink = made.stages[3]
    assert sink.joins and [(each.stage, each.latest, each.max_age_ms) for each in sink.inputs or ()] == [
        ("left", False, 0),
        ("source", False, 0),
        ("right", True, 40),
    ]
    settings = sink.settings
    assert [(each["name"], each["stream"], each["port"]) for each in settings["reads"]] == [
        ("x", 0, "b"),
        ("y", 0, "a"),
        ("z", 1, ""),
        ("w", 2, ""),
    ]
    assert settings["streams"] == [{"a": "f32 3", "b": "u8 5"}, {"": "u8 4x6x3"}, {"": "u8 1"}]
    assert (settings["writes"], made.stages[1].settings["writes"]) == ({}, {"a": "f32 3", "b": "u8 5"})
    assert made.graph().from_release and made.stages[2].every == 2 and made.latency_to == "sink"
    assert not made.graph().is_chain, "else frames would go through it before the run"


def test_a_run_imports_the_code_that_it_names(tmp_path: Path) -> None:
    file = read(tmp_path)
    assert imports_of(file) == ["own"]
    blocks = "trilane.stages.blocks"
    assert preload_of(file) == (f"{blocks}.video", f"{blocks}.own_code")


def test_a_run_has_as_many_frames_as_the_pictures(tmp_path: Path) -> None:
    assert frames_of(read(tmp_path)) == 7
    assert frames_of(read(tmp_path, TEXT.replace("fps = 20", "frames = 9"))) == 9
    source = 'source = { block = "busy", unit = "cpu", load_ms = 1.0 }'
    lines = [source if line.startswith("source") else line for line in TEXT.splitlines()]
    assert frames_of(read(tmp_path, "\n".join(lines))) == DEFAULT_FRAMES


@pytest.mark.parametrize(
    ("cores", "expected"),
    [
        ((4,), {"cpu": (4,), "gpu": (4,), "dsp": (4,)}),
        ((4, 6), {"cpu": (4,), "gpu": (6,), "dsp": (4,)}),
        ((0, 1, 2, 3, 4), {"cpu": (0,), "gpu": (1,), "dsp": (2,)}),
    ],
)
def test_cores_are_dealt_out_in_turn(cores: tuple[int, ...], expected: dict[str, Any], tmp_path: Path) -> None:
    found = cores_of(read(tmp_path), cores)
    assert {unit: settings.cores for unit, settings in found.items()} == expected
    assert {unit: settings.threads for unit, settings in found.items()} == dict.fromkeys(expected, 1)


def test_cores_that_the_file_names_are_those(tmp_path: Path) -> None:
    file = read(tmp_path, TEXT + "[units]\ncpu = { cores = [3, 1], threads = 1 }\n")
    found = cores_of(file, (0, 1, 2, 3))
    assert [(each.cores, each.threads) for each in found.values()] == [((1, 3), 1), ((0,), 1), ((1,), 1)]
    with pytest.raises(BadInputError, match=r"units.cpu.cores: found core 3, expected cores .*: 0, 1"):
        cores_of(file, (0, 1))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (', out = { a = "f32 3", b = "u8 5" }', "", "stages.left.out: found nothing, expected the type"),
        ('path = "pictures"', 'path = "0"', "stages.source.path: found a camera"),
        ('block = "busy", unit = "dsp", in = "source", load_ms = 1.0', 'unit = "dsp", in = "source", time_ms = 1',
         "stages.right: found a time alone"),
    ],
)  # fmt: skip
def test_what_cannot_be_run_is_refused_by_name(old: str, new: str, match: str, tmp_path: Path) -> None:
    file = read(tmp_path, TEXT.replace(old, new))
    with pytest.raises(BadInputError, match=match):
        pipeline_of(file, tmp_path)


def test_options_of_a_run_stand_for_keys_of_the_file(tmp_path: Path) -> None:
    read(tmp_path)
    asked = asked_file(
        RunOptions(scene=str(tmp_path / "file.toml"), frames=5, fps=10.0, policy="latest", edge="fifo:3")
    )
    assert (asked.run.frames, asked.run.fps, asked.run.policy, asked.run.edge) == (5, 10.0, "latest", "fifo:3")
    with pytest.raises(BadInputError, match="found --size with a pipeline file, expected one of --frames, --fps"):
        asked_file(RunOptions(scene=str(tmp_path / "file.toml"), size="128"))
