"""`trilane check`: what it says of right files, and how it refuses wrong ones."""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import onnx
import pytest

from support.pipeline_files import BRANCHES, CUT, DEPTH, STREET, write_file
from trilane.apps.check.checked import check_scene
from trilane.apps.predict.asked_pipelines import asked, avatar
from trilane.pipeline.description import (
    Pipeline,
    PipelineEdge,
    PipelineStage,
    StageInput,
    UnitSettings,
    file_text,
    tables_of,
    unsaid,
)
from trilane.pipeline.file_graph import edge_rules, graph_of, skips_of
from trilane.pipeline.pipeline_file import checked_tables, read_pipeline
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.transport.packets import header_dtype

Command = Callable[..., tuple[str, str]]


@pytest.fixture
def check(command: Command, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """The document of `trilane check` for a text."""
    return lambda text: json.loads(command("check", write_file(tmp_path, text), "--json")[0])


def test_the_document_of_a_join(check: Callable[..., dict[str, Any]]) -> None:
    document = check(DEPTH)
    assert [(each["name"], each["unit"], each["kind"]) for each in document["stages"]] == [
        ("frame", "a", "time_ms"),
        ("depth", "b", "time_ms"),
        ("seg", "c", "time_ms"),
        ("composite", "d", "time_ms"),
    ]
    assert [(each["from"], each["to"], each["slots"]) for each in document["streams"]] == [
        ("frame", ["depth", "seg"], 2),
        ("depth", ["composite"], 2),
        ("seg", ["composite"], 2),
    ]
    assert (document["period_ms"], document["cycle"]) == (14, ["depth"])


@pytest.mark.parametrize(
    ("head", "period", "cycle"),
    [
        ('[run]\nedge = "single"', 17, ["depth", "composite"]),
        ("[run]\nfps = 50", 20, ["frame"]),
        ("[run]\nin_flight = 1", 19, ["frame", "depth", "composite"]),
    ],
)
def test_what_makes_the_period(
    check: Callable[..., dict[str, Any]], head: str, period: float, cycle: list[str]
) -> None:
    document = check(head + DEPTH)
    assert (document["period_ms"], document["cycle"]) == (period, cycle)


def test_the_published_cut(check: Callable[..., dict[str, Any]]) -> None:
    assert (check(CUT)["period_ms"], check(CUT)["cycle"]) == (1.1717, ["tail"])


def test_the_street_has_no_period_without_times_but_memory(check: Callable[..., dict[str, Any]]) -> None:
    document = check(STREET)
    assert (document["period_ms"], document["cycle"]) == (None, [])
    picture, network, boxes, mask = 640 * 480 * 3, 3 * 128**2 * 4, 8 * 128**2 * 4, 8 * 256**2 * 4
    slots = {each["from"]: each["slots"] for each in document["streams"]}
    assert slots == {"camera": 6, **dict.fromkeys(("small", "detector", "crop", "segmenter", "overlay"), 2)}
    assert document["memory_bytes"] == 6 * picture + 2 * (network + boxes + 256 * 256 * 3 + mask + picture)
    assert document["imports"] == ["crop:best"]


def test_nothing_of_a_file_is_imported(command: Command, tmp_path: Path) -> None:
    (tmp_path / "crop.py").write_text(f"open({str(tmp_path / 'was_run')!r}, 'w')\n")
    command("check", write_file(tmp_path, STREET))
    command("predict", tmp_path / "pipeline.toml", code=2)
    assert "crop" not in sys.modules
    assert not (tmp_path / "was_run").exists()


def test_the_text_of_a_file(command: Command, tmp_path: Path, check_printed: Callable[[str, str], None]) -> None:
    texts = [command("check", write_file(tmp_path, text))[0] for text in (STREET, BRANCHES, CUT, DEPTH)]
    check_printed("check", "\n".join(texts).replace(f"{tmp_path}/", ""))


def test_the_drawing_has_a_box_for_each_stage_and_a_line_for_each_input(command: Command, tmp_path: Path) -> None:
    out = tmp_path / "graph.svg"
    command("check", write_file(tmp_path, BRANCHES), "--svg", out)
    drawing = ElementTree.parse(out).getroot()  # noqa: S314 - our own
    name = "{http://www.w3.org/2000/svg}"
    boxes = drawing.findall(f"{name}g")
    titles = [box.findtext(f"{name}title", "").partition(":")[0] for box in boxes]
    assert titles == ["frame", "depth", "seg", "detector", "tracker", "composite"]
    lines = drawing.findall(f"{name}path")
    assert [len(lines), sum("stroke-dasharray" in line.attrib for line in lines)] == [9, 1]
    corners = [(box.find(f"{name}rect").attrib["x"], box.find(f"{name}rect").attrib["y"]) for box in boxes]  # type: ignore[union-attr]
    assert len(set(corners)) == len(boxes)  # none hides another
    command("check", tmp_path / "pipeline.toml", "--svg", tmp_path / "graph.png", code=2)


A = 'a = { unit = "u", time_ms = 1 }\n'
STAGES = f"[stages]\n{A}"
VIDEO = 'v = { block = "video", unit = "cpu", path = "v.mp4", size = "640x480" }\n'
NET = 'n = { onnx = "seg.onnx", unit = "dsp", in = "a" }\n'
#: Frames may go from the first of three stages past the second.
ROW = """[stages]
a = {{ unit = "u", time_ms = 1, bypass = {} }}
b = {{ unit = "v", in = "a", time_ms = 1 }}
c = {{ unit = "u", in = "b", time_ms = 1 }}
"""
PREPARED = f'[stages]\n{VIDEO}{NET}a = {{ block = "prepare", unit = "cpu", in = "v", like = "n" }}\n'

#: What is wrong: the file, then what the message must name, the key first.
WRONG: dict[str, tuple[str, ...]] = {
    "circle": (
        '[stages]\na = { unit = "u", in = "c", time_ms = 1 }\nb = { unit = "u", in = "a", time_ms = 1 }\n'
        'c = { unit = "u", in = "b", time_ms = 1 }',
        *("stages.a.in", "the circle a -> b -> c -> a", "take one of these inputs away"),
    ),
    "itself": ('[stages]\na = { unit = "u", in = "a", time_ms = 1 }', "stages.a.in", "the circle a -> a"),
    "circle of newest": (
        STAGES + 'b = { unit = "u", in = { x = "a", y = { from = "c", sync = "latest" } }, time_ms = 1 }\n'
        'c = { unit = "u", in = "b", time_ms = 1 }',
        *("stages.b.in", "b -> c -> b"),
    ),
    "dangling port": (
        '[stages]\na = { unit = "u", time_ms = 1, out = { boxes = "f32 32x5" } }\n'
        'b = { unit = "u", in = "a.boxs", time_ms = 1 }',
        *("stages.b.in", "'boxs' of a", "did you mean 'boxes'?"),
    ),
    "dangling port of a network": (
        STAGES + NET + 'b = { unit = "u", in = "n.masc", time_ms = 1 }',
        *("stages.b.in", "'masc' of n", "did you mean 'mask'?"),
    ),
    "port that nobody feeds": (
        f'[stages]\n{VIDEO}o = {{ block = "overlay", unit = "gpu", in = {{ mask = "v" }} }}',
        *("stages.o.in", "nobody who feeds the input 'frame'", 'add in = { frame = "STAGE" }'),
    ),
    "nobody to encode": (
        f'[stages]\n{VIDEO}e = {{ block = "encode", unit = "cpu", path = "o.mp4" }}',
        *("stages.e.in", "nobody who feeds an input of encode", 'add in = "STAGE"'),
    ),
    "unknown port of a block": (
        f'[stages]\n{VIDEO}o = {{ block = "overlay", unit = "gpu", in = {{ frame = "v", masc = "v" }} }}',
        *("stages.o.in.masc", "did you mean 'mask'?"),
    ),
    "unknown input of a network": (
        STAGES + 'n = { onnx = "seg.onnx", unit = "dsp", in = { imag = "a" } }',
        *("stages.n.in", "'imag'", "did you mean 'image'?"),
    ),
    "which of several ports": (
        '[stages]\na = { unit = "u", time_ms = 1, out = { x = "u8 4", y = "u8 4" } }\n'
        'b = { unit = "u", in = "a", time_ms = 1 }',
        *("stages.b.in", "the ports x, y", "'a.x'"),
    ),
    "a network behind nothing": (
        '[stages]\nn = { onnx = "seg.onnx", unit = "dsp" }',
        *("stages.n.in", "nobody who feeds the input 'image'"),
    ),
    "unknown stage": (
        STAGES.replace("a =", "camera =") + 'b = { unit = "u", in = "camra", time_ms = 1 }',
        *("stages.b.in", "the unknown stage 'camra'", "a stage of the file: camera, b;", "did you mean 'camera'?"),
    ),
    "a stage like no other": (
        STAGES + 'b = { unit = "u", in = "xyz", time_ms = 1 }',
        *("stages.b.in", "a stage of the file: a, b;", "add it to [stages]"),
    ),
    "a source that reads": (
        f"[stages]\n{VIDEO}".replace(" }", ', in = "v" }'),
        *("stages.v.in", "an input, expected none, as video is a source", "leave it out"),
    ),
    "one stage in two ways": (
        STAGES + 'b = { unit = "u", in = { x = "a", y = { from = "a", sync = "latest" } }, time_ms = 1 }',
        *("stages.b.in.y", "'a' with another sync or age", "the same sync and max_age_ms"),
    ),
    "number for a table": ("run = 3\n" + STAGES, "run", "3, expected a table", "begin it with the line [run]"),
    "number for a unit": ("[units]\nu = 3\n" + STAGES, "units.u", "3, expected a table with hardware", "in braces"),
    "unknown unit": (
        '[units]\nneural = { hardware = "dsp" }\n[stages]\na = { unit = "neurl", time_ms = 1 }',
        *("stages.a.unit", "the unknown unit 'neurl'", "did you mean 'neural'?"),
    ),
    "network on an unknown unit": (STAGES + NET.replace("dsp", "npu"), "stages.n.unit", "'npu'", "hardware"),
    "unknown hardware": ('[units]\nu = { hardware = "dps" }\n' + STAGES, "units.u.hardware", "did you mean 'dsp'?"),
    "twice the same stage": (STAGES + A, "line 3", "the same name twice"),
    "twice the same table": (STAGES + STAGES, "line 3", "the same name twice"),
    "two kinds": (
        STAGES + 'b = { onnx = "seg.onnx", python = "m:f", unit = "cpu", in = "a" }',
        *("stages.b", "onnx and python", "exactly one"),
    ),
    "no kind": (STAGES + 'b = { unit = "u", in = "a" }', "stages.b", "none of onnx, python, block, time_ms"),
    "a kind with a slip": (STAGES + 'b = { unit = "u", in = "a", time = 3 }', "stages.b", "did you mean 'time_ms'?"),
    "missing model": (STAGES + NET.replace("seg", "none"), "stages.n.onnx", "no such file", "put none.onnx beside"),
    "no model": (STAGES + NET.replace("seg.onnx", "pipeline.toml"), "stages.n.onnx", "expected"),
    "path outside": (STAGES + NET.replace("seg.onnx", "../seg.onnx"), "stages.n.onnx", "'../seg.onnx'", "inside"),
    "path from the root": (STAGES + NET.replace("seg.onnx", "/etc/passwd"), "stages.n.onnx", "inside the folder"),
    "path round about": (STAGES + NET.replace("seg.onnx", "x/../../seg.onnx"), "stages.n.onnx", "inside the folder"),
    "video written outside": (
        f'[stages]\n{VIDEO}e = {{ block = "encode", unit = "cpu", in = "v", path = "../../out.mp4" }}',
        *("stages.e.path", "inside the folder"),
    ),
    "code written over": (
        f'[stages]\n{VIDEO}e = {{ block = "encode", unit = "cpu", in = "v", path = "own.py" }}',
        *("stages.e.path", "'own.py'", "let the name end with .mp4"),
    ),
    "video written over what is read": (
        f'[stages]\n{VIDEO}e = {{ block = "encode", unit = "cpu", in = "v", path = "x/../v.mp4" }}',
        *("stages.e.path", "the path of v", "choose another name"),
    ),
    "video written twice": (
        f'[stages]\n{VIDEO}e = {{ block = "encode", unit = "cpu", in = "v", path = "o.mp4" }}\n'
        'f = { block = "encode", unit = "cpu", in = "v", path = "./o.mp4" }',
        *("stages.f.path", "'./o.mp4', the path of e"),
    ),
    "text for a number": ('[run]\nfps = "30"\n' + STAGES, "run.fps", "'30'", "number"),
    "true for a number": (STAGES.replace("= 1", "= true"), "stages.a.time_ms", "true", "a time in ms"),
    "number for a stage": ("[stages]\na = 3", "stages.a", "3", "a table"),
    "number for an input": (STAGES + 'b = { unit = "u", in = 3, time_ms = 1 }', "stages.b.in", "3", "stage.port"),
    "two gigabytes": (
        '[stages]\na = { unit = "u", time_ms = 1, out = "u8 50000x50000" }',
        *("stages.a.out", "2500000000 bytes", "at most 256 MiB", "smaller"),
    ),
    "slots of gigabytes": (
        '[edges]\na = "fifo:64"\n[stages]\na = { unit = "u", time_ms = 1, out = "u8 250000000" }\n'
        'b = { unit = "v", in = "a", time_ms = 1 }',
        *("edges.a", "64 slots of 238 MiB", "at most 2 GiB"),
    ),
    "a huge picture": (
        f"[stages]\n{VIDEO}".replace("640x480", "999999x999999"),
        *("stages.v.size", "'999999x999999'", "1 to 16384"),
    ),
    "unknown type": (
        '[stages]\na = { unit = "u", time_ms = 1, out = "float 4" }',
        *("stages.a.out", "'float'", "u8, i8"),
    ),
    "wrong shape": (
        STAGES.replace("time_ms = 1", 'time_ms = 1, out = "f32 1x3x128x128"') + NET,
        *("stages.n.in", "f32 1x3x128x128 from a", "f32 1x3x256x256"),
    ),
    "wrong type": (
        STAGES.replace("time_ms = 1", 'time_ms = 1, out = "i8 1x3x256x256"') + NET,
        *("stages.n.in", "i8 1x3x256x256 from a", "f32 1x3x256x256"),
    ),
    "no picture to encode": (
        STAGES.replace("time_ms = 1", 'time_ms = 1, out = "f32 32x5"')
        + 'e = { block = "encode", unit = "cpu", in = "a", path = "o.mp4" }',
        *("stages.e.in", "f32 32x5 from a", "a picture", "overlay draws"),
    ),
    "too many inputs": (
        "[stages]\n"
        + "".join(f'a{n} = {{ unit = "u", time_ms = 1 }}\n' for n in range(8))
        + 'b = { unit = "u", time_ms = 1, in = { '
        + ", ".join(f'p{n} = "a{n}"' for n in range(8))
        + " } }",
        *("stages.b.in", "8 stages", "at most 7"),
    ),
    "too many stages": (
        "[stages]\n" + "".join(f'a{n} = {{ unit = "u", time_ms = 1 }}\n' for n in range(65)),
        *("stages", "65 stages", "1 to 64"),
    ),
    "no stages": ('[stages]\n[run]\nedge = "double"', "stages", "0 stages", "`trilane init`"),
    "negative time": (STAGES.replace("= 1", "= -1"), "stages.a.time_ms.mean", "-1", "greater than or equal to 0"),
    "no number": (STAGES.replace("= 1", "= nan"), "stages.a.time_ms.mean", "nan", "finite"),
    "endless time": (STAGES.replace("= 1", "= inf"), "stages.a.time_ms.mean", "inf", "finite"),
    "no samples": (STAGES.replace("= 1", "= { samples = [] }"), "stages.a.time_ms", "0 samples"),
    "two kinds of times": (
        STAGES.replace("= 1", "= { mean = 1, exponential = 2 }"),
        *("stages.a.time_ms", "mean, exponential"),
    ),
    "a negative sample": (STAGES.replace("= 1", "= { samples = [1, -2] }"), "stages.a.time_ms.samples.1", "-2"),
    "unknown table": (STAGES + "[runs]\nfps = 3", "'runs'", "did you mean 'run'?"),
    "unknown key of the run": ("[run]\nfsp = 30\n" + STAGES, "run.fsp", "did you mean 'fps'?"),
    "unknown key of a stage": (STAGES.replace("unit", "evry = 3, unit"), "stages.a.evry", "did you mean 'every'?"),
    "unknown key of a time": (
        STAGES.replace("= 1", "= { mean = 1, std = 1 }"),
        *("stages.a.time_ms.std", "the unknown key 'std'", "mean, sd"),
    ),
    "unknown key of an input": (
        STAGES + 'b = { unit = "u", in = { x = { from = "a", snyc = "latest" } }, time_ms = 1 }',
        *("stages.b.in.x.snyc", "did you mean 'sync'?"),
    ),
    "unknown block": (
        f"[stages]\n{VIDEO}".replace('"video"', '"vidoe"'),
        *("stages.v.block", "did you mean 'video'?"),
    ),
    "unknown sync": (
        STAGES + 'b = { unit = "u", in = { from = "a", sync = "newest" }, time_ms = 1 }',
        *("stages.b.in.sync", "'frame' or 'latest'"),
    ),
    "an age without newest": (
        STAGES + 'b = { unit = "u", in = { from = "a", max_age_ms = 3 }, time_ms = 1 }',
        *("stages.b.in", "max_age_ms beside sync = 'frame'"),
    ),
    "one slot for a newest frame": (
        STAGES + 'b = { unit = "u", in = { from = "a", sync = "latest" }, time_ms = 1 }\n[edges]\na = "single"',
        *("edges.a", "two slots or more"),
    ),
    "unknown edge": (STAGES + '[edges]\na = "double"', "edges.a", "a stage that nobody reads"),
    "unknown rule": (
        STAGES + 'b = { unit = "u", in = "a", time_ms = 1 }\n[edges]\na = "quadruple"',
        *("edges.a", "'quadruple'", "single, double, triple"),
    ),
    "unknown policy": ('[run]\npolicy = "lates"\n' + STAGES, "run.policy", "did you mean 'latest'?"),
    "policy without a rate": ('[run]\npolicy = "latest"\n' + STAGES, "run.policy", "add fps = 30"),
    "two rates": ("[run]\nfps = 3\narrivals = { poisson = 3 }\n" + STAGES, "run.arrivals", "one or the other"),
    "latency to nowhere": (
        '[run]\nlatency_to = "b"\n' + STAGES,
        *("run.latency_to", "the unknown stage 'b'", "of the file: a"),
    ),
    "prepared for nobody": (
        f'[stages]\n{VIDEO}p = {{ block = "prepare", unit = "cpu", in = "v", like = "det" }}',
        *("stages.p.like", "'det'", "a stage with onnx"),
    ),
    "own code without a factory": (
        STAGES + 'b = { python = "crop", unit = "cpu" }',
        *("stages.b.python", "'crop', expected MODULE:FACTORY, such as crop:best"),
    ),
    "a unit with a space": (
        STAGES.replace('"u"', '"a unit"'),
        *("stages.a.unit", "'a unit', expected at most 40 letters from a to z or A to Z, digits, _ and -"),
    ),
    "a unit whose socket would have too long a path": (
        STAGES.replace('"u"', '"' + "漢" * 40 + '"'),
        *("stages.a.unit", "expected at most 40 letters from a to z"),
    ),
    "a stage name with an umlaut": (
        STAGES.replace("a =", '"überlagerung" =').replace('"a"', '"überlagerung"'),
        *("stages", "the name 'überlagerung', expected at most 40 letters from a to z"),
    ),
    "no cores": (STAGES + "[units]\nu = { cores = [] }", "units.u.cores", "at least 1 item;"),
    "means of two channels": (
        PREPARED.replace("like", "mean = [0.5, 0.5], like"),
        *("stages.a.mean", "2 values", "1 or 3, one for each channel"),
    ),
    "a mean that is no number": (PREPARED.replace("like", "mean = [nan], like"), "stages.a.mean.0", "nan", "finite"),
    "no deviation": (PREPARED.replace("like", "sd = [0], like"), "stages.a.sd.0", "0", "greater than 0"),
    "another size than the network's": (
        f"[stages]\n{VIDEO}" + NET.replace('"a"', '"v", shapes = { image = "1x3x128x256" }'),
        *("stages.n.shapes.image", "1x3x128x256, expected 1x3x256x256", "leave it out"),
    ),
    "a layout of five channels": (
        PREPARED.replace("like", 'layout = "nhwc", like'),
        *("stages.a", "f32 1x3x256x256", "1 or 3 channels"),
    ),
    "every nothing": (STAGES.replace("unit", "every = 0, unit"), "stages.a.every", "greater than or equal to 1"),
    "a name with a dot": ('[stages]\n"a.b" = { unit = "u", time_ms = 1 }', "stages", "'a.b'"),
    "behind the end": (
        f'[stages]\n{VIDEO}d = {{ block = "discard", unit = "cpu", in = "v" }}\n'
        'b = { unit = "u", in = "d", time_ms = 1 }',
        *("stages.b.in", "'d', a discard"),
    ),
    "a bypass to an unknown stage": (ROW.format('"d"'), "stages.a.bypass.to", "'d', an unknown stage", "one of c"),
    "a bypass to the next stage": (ROW.format('"b"'), "stages.a.bypass.to", "'b', a stage before or next to it"),
    "a bypass at a network": (
        STAGES + NET.replace(" }", ', bypass = "c" }') + 'b = { unit = "u", in = "n", time_ms = 1 }\n'
        'c = { unit = "u", in = "b", time_ms = 1 }',
        *("stages.n.bypass", "a bypass at onnx", "python, busy or only time_ms"),
    ),
    "a bypass among branches": (
        ROW.format('"c"') + 'd = { unit = "u", in = "a", time_ms = 1 }',
        *("stages.a.bypass", "a bypass in a pipeline with branches, at d", "a row of stages", "without every"),
    ),
    "two bypasses": (
        ROW.format('"c"').replace('"v"', '"v", bypass = "d"') + 'd = { unit = "u", in = "c", time_ms = 1 }',
        *("stages.b.bypass", "a second bypass", "leave it out here, or at a"),
    ),
    "a bypass with share and pattern": (
        ROW.format('{ to = "c", share = 0.5, pattern = "01" }'),
        *("stages.a.bypass", "share and pattern", "one of them"),
    ),
    "a bypass for more than all": (ROW.format('{ to = "c", share = 1.5 }'), "stages.a.bypass.share", "1.5", "to 1"),
    "a pattern of letters": (ROW.format('{ to = "c", pattern = "01x" }'), "stages.a.bypass.pattern", "'01x'", "'0011'"),
    "unknown key of a bypass": (
        ROW.format('{ to = "c", shar = 0.5 }'),
        *("stages.a.bypass.shar", "did you mean 'share'?"),
    ),
    "number for a bypass": (ROW.format("3"), "stages.a.bypass", "3", "a stage, or a table"),
    "latency to a stage that frames skip": (
        '[run]\nlatency_to = "b"\n' + ROW.format('"c"'),
        *("run.latency_to", "'b', past which frames of a may go", "such as c"),
    ),
    "a bypass to a stage that needs more": (
        '[stages]\na = { python = "m:f", unit = "u", out = "f32 2", bypass = "e" }\n'
        'b = { python = "m:g", unit = "u", in = "a", out = "u8 4x6x3" }\n'
        'e = { block = "encode", unit = "u", in = "b", path = "o.mp4" }',
        *("stages.a.bypass.to", "'e', which needs a port with u8 4x6x3 also from a", "python"),
    ),
    "no TOML": (STAGES + "b = = 3", "line 3", "no TOML", "Invalid value"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_refused_by_its_key(command: Command, tmp_path: Path, name: str) -> None:
    text, *parts = WRONG[name]
    path = write_file(tmp_path, text)
    _, err = command("check", path, code=2)
    said = " ".join(err.split())
    assert said.startswith(f"error: {path}"), said
    found, _, expected = said.partition(", expected ")
    assert "found" in found
    assert expected.partition("; ")[2], "no remedy"
    assert all(part in said for part in parts), said
    assert "Traceback" not in said


@pytest.mark.parametrize("name", ["circle", "missing model", "two kinds", "negative time"])
def test_a_prediction_refuses_it_alike(command: Command, tmp_path: Path, name: str) -> None:
    path = write_file(tmp_path, WRONG[name][0])
    assert command("predict", path, code=2)[1] == command("check", path, code=2)[1]


def test_bytes_that_are_no_text_and_a_missing_file(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "bytes.toml"
    path.write_bytes(b"[stages]\n\xff\xfe\x00")
    assert "no text in UTF-8" in (said := command("check", path, code=2)[1])
    assert "save it as UTF-8" in said
    path.write_bytes(b"")
    assert "an empty file" in (said := command("check", path, code=2)[1])
    assert "`trilane init`" in said
    assert "no such file" in command("check", tmp_path / "none.toml", code=2)[1]
    assert "a folder" in command("check", tmp_path, code=2)[1]


def test_a_network_of_open_sizes_wants_them_from_the_file(command: Command, tmp_path: Path) -> None:
    path = write_file(tmp_path, STAGES + NET)
    model = onnx.load(tmp_path / "seg.onnx")
    model.graph.input[0].type.tensor_type.shape.dim[2].dim_param = "height"
    onnx.save(model, tmp_path / "seg.onnx")
    error = " ".join(command("check", path, code=2)[1].split())
    found = re.search(r"add shapes = \{ image = '1x3xNx256' \}", error)
    assert found, error
    path.write_text(STAGES + NET.replace(" }", ", shapes = { image = '1x3x256x256' } }"))
    command("check", path)


def test_weights_that_are_inputs_need_no_stage(command: Command, tmp_path: Path) -> None:
    """A graph without the values of its weights, as published ones are, has them as inputs."""
    path = write_file(tmp_path, STAGES + NET)
    model = onnx.load(tmp_path / "seg.onnx")
    sizes = list(model.graph.initializer.pop().dims)
    model.graph.input.append(onnx.helper.make_tensor_value_info("weights", onnx.TensorProto.FLOAT, sizes))
    onnx.save(model, tmp_path / "seg.onnx")
    assert json.loads(command("check", path, "--json")[0])["stages"][1]["what"] == "seg.onnx"


def test_a_graph_without_weights_is_fed_its_picture_alone(command: Command, tmp_path: Path) -> None:
    text = '[stages]\na = { block = "video", unit = "cpu", path = "v.mp4", size = "16x16", time_ms = 1 }\n'
    path = write_file(tmp_path, text + 'n = { onnx = "bare.onnx", unit = "dsp", in = "a" }')
    sizes = {"image": (1, 3, 16, 16), "w0": (2, 3, 3, 3), "w1": (2,), "out": (1, 2, 14, 14)}
    values = {name: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, sizes[name]) for name in sizes}
    layer = onnx.helper.make_node("Conv", ["image", "w0", "w1"], ["out"])
    graph = onnx.helper.make_graph([layer], "bare", [values[name] for name in ("image", "w0", "w1")], [values["out"]])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "bare.onnx")
    command("check", path)
    command("predict", path, "--profile", "snapdragon-8-gen-3")
    error = " ".join(command("run", path, "--frames", "2", "--out", tmp_path / "run", code=2)[1].split())
    assert "stages.n.onnx: found bare.onnx without weights: 2 are inputs without values" in error


def test_a_line_between_stages_of_one_row_passes_over_the_box_between(command: Command, tmp_path: Path) -> None:
    stages = 'a = { unit = "u", time_ms = 1 }\nb = { unit = "u", in = "a", time_ms = 1 }\n'
    text = f'[stages]\n{stages}c = {{ unit = "u", in = {{ a = "a", b = "b" }}, time_ms = 1 }}'
    command("check", write_file(tmp_path, text), "--svg", tmp_path / "graph.svg")
    paths = re.findall(r"<path d='([^']*)'", (tmp_path / "graph.svg").read_text())
    assert [" H " in path for path in paths] == [False, True, False]


def test_a_bypass_is_shown_with_what_it_saves(command: Command, tmp_path: Path) -> None:
    """Frames 1 and 2 of 4 skip b, whose unit then works 1 of 4 ms for two frames of four: 2 of u, 0.5 of v."""
    path = write_file(tmp_path, ROW.format('{ to = "c", pattern = "0110" }'))
    document = json.loads(command("check", path, "--svg", tmp_path / "graph.svg", "--json")[0])
    assert document["routes"] == [{"from": "a", "to": "c", "past": ["b"], "share": 0.5}]
    assert (document["period_ms"], document["limit"], document["cycle"]) == (2, "unit u", ["a", "c"])
    assert "bypass    a -> c, past b: 50.0% of the frames" in command("check", path)[0]
    assert (tmp_path / "graph.svg").read_text(encoding="utf-8").count("stroke-dasharray='1 4'") == 1
    path = write_file(tmp_path, ROW.format('"c"').replace('"v", in = "a", time_ms = 1', '"v", in = "a", time_ms = 9'))
    document = json.loads(command("check", path, "--json")[0])
    assert document["routes"][0]["share"] is None and document["period_ms"] == 9
    notes = json.loads(command("predict", path, "--json")[0])["notes"]
    assert notes == ["no frame takes the bypass of a: its table says neither share nor pattern"]


@pytest.mark.parametrize("scene", ["default", "portrait", "walk-past"])
def test_a_scene_is_printed_as_a_file_with_the_same_streams_and_the_same_least_period(
    command: Command, tmp_path: Path, scene: str
) -> None:
    """On a chip the period is that of the unit with the most work, worked out from the printed times."""
    printed, text = check_scene(scene, "snapdragon-888")
    document = printed.as_json()
    path = tmp_path / "printed.toml"
    path.write_text(text, encoding="utf-8")
    again = json.loads(command("check", path, "--json")[0])
    for key in ("run", "latency_to", "units", "stages", "streams", "routes", "period_ms", "cycle", "limit"):
        assert again[key] == document[key], key
    assert again["memory_bytes"] == document["memory_bytes"]
    checked = configure(RunOptions(scene=scene, skinning="gpu"), tmp_path)
    described, file = avatar_pipeline(checked.config, checked.assets, "double"), read_pipeline(path)
    assert graph_of(file, edge_rules(file)) == described.graph(), "nothing of the description is lost"
    (route,) = document["routes"]
    assert (route["from"], route["to"], route["past"]) == ("pose", "composite", ["raster", "infer"])
    planned, skips = avatar(asked(scene), scene), skips_of(file)
    frames = range(len(planned.frames) + 2)
    assert [skips(frame, False) for frame in frames] == [planned.skips(frame, False) for frame in frames]
    assert (route["share"] > 0) == (scene == "walk-past")
    busy: dict[str, float] = {}
    for stage in document["stages"]:
        part = 1 - route["share"] if stage["name"] in route["past"] else 1
        busy[stage["unit"]] = busy.get(stage["unit"], 0.0) + part * stage["time_ms"]
    assert document["period_ms"] == pytest.approx(max(busy.values()), abs=1e-9)
    predicted = json.loads(command("predict", path, "--json")[0])["pipelines"][0]
    alone = json.loads(command("predict", scene, "--profile", "snapdragon-888", "--json")[0])["pipelines"][0]
    for name, row in predicted["stages"].items():
        assert row["alone_ms"] == pytest.approx(alone["stages"][name]["alone_ms"], abs=2e-6)
    if not route["share"]:
        assert predicted["needs_ms"]["mean"] == pytest.approx(alone["needs_ms"]["mean"], rel=0.01)


def test_a_scene_without_a_chip_has_no_times_and_a_file_is_no_scene(command: Command, tmp_path: Path) -> None:
    drawing = tmp_path / "default.svg"
    document = json.loads(command("check", "default", "--svg", drawing, "--json")[0])
    assert document["period_ms"] is None and document["routes"][0]["share"] is None
    assert drawing.read_text(encoding="utf-8").count("<title>") == 5
    (tmp_path / "own.toml").write_text('avatars = [{ bundle = "none" }]\n', encoding="utf-8")
    assert "none" in command("check", tmp_path / "own.toml", code=2)[1]
    file = write_file(tmp_path, DEPTH)
    assert (
        "found snapdragon-888 beside a pipeline file"
        in command("check", file, "--profile", "snapdragon-888", code=2)[1]
    )
    assert "predict default --profile host" in command("check", "default", "--profile", "host", code=2)[1]


def test_a_description_with_forks_joins_and_edges_of_its_own_is_written_as_the_same_graph(tmp_path: Path) -> None:
    def stage(name: str, *inputs: StageInput, **others: Any) -> PipelineStage:
        return PipelineStage(name=name, unit=f"u-{name}", factory="some:thing", inputs=inputs, **others)

    from_a, newest = StageInput(stage="a"), StageInput(stage="b", latest=True, max_age_ms=250.0)
    stages = (stage("a"), stage("b", from_a, every=3), stage("c", from_a, newest, pace_ns=2_000_000))
    pipeline = Pipeline(
        stages=stages,
        edges=(
            PipelineEdge(payload_bytes=12, rule="fifo:4"),
            PipelineEdge(payload_bytes=0, header=header_dtype([("x", "<f8")]), rule="triple"),
        ),
        units={each.unit: UnitSettings(cores=(0,), threads=1) for each in stages},
    )
    tables = tables_of(pipeline, {}, {"a": 1.5})
    path = tmp_path / "made.toml"
    path.write_text(file_text(tables, ["one", "two"]), encoding="utf-8")
    assert tomllib.loads(file_text({"t": {"a": "\x7f \0 ü 😀"}})) == {"t": {"a": "\x7f \0 ü 😀"}}
    file = read_pipeline(path)
    assert file == checked_tables(tables, path)
    rules = edge_rules(file)
    assert graph_of(file, rules) == pipeline.graph()
    assert file.stages["a"].own_time is not None and file.stages["b"].own_time is None
    said = list(unsaid(pipeline))
    assert [("header" in each, "c 2 ms" in each) for each in said[1:]] == [(True, False), (False, True)]
