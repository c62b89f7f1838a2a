"""`trilane predict` and `trilane profiles` as a person calls them: JSON alone on stdout, exit codes, named errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Command = Callable[..., tuple[str, str]]
Answer = Callable[..., Any]


@pytest.fixture
def answer(command: Command) -> Answer:
    """The JSON document that `trilane ARGUMENTS --json` prints, which must be all that it prints."""
    return lambda *arguments: json.loads(command(*arguments, "--json")[0])


def test_predict_answers_a_table(tmp_path: Path, answer: Answer, command: Command) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("encoder,norm,params_m,size,channels,layout\nmobilenetv3,batch,6.7,640,8,packed\n")
    document = answer("predict", "--table", str(path))
    assert set(document["rows"][0]) >= {
        "encoder",
        "bench_gpu_ms",
        "bench_dsp_ms",
        "app_gpu_ms",
        "app_dsp_ms",
        "confidence",
    }
    assert "mobilenetv3" in command("predict", "--table", str(path))[0]


def test_predict_answers_for_an_avatar(tiny_bundle: Path, answer: Answer) -> None:
    document = answer("predict", "--avatar", str(tiny_bundle))
    assert document["config"]["avatar"] == str(tiny_bundle)
    assert document["config"]["size"] == "64x64"
    by_file = answer("predict", "--application", "--network", str(tiny_bundle / "network.onnx"))
    assert by_file["network"] == document["network"]


def test_predict_says_what_it_is_of(command: Command) -> None:
    """The settled rate first, the assumed part of the power, and no word that means two things."""
    text = command("predict", "--size", "512", "--performance-profile", "burst", "--minutes", "30")[0]
    lines = {line[:16].strip(): line[16:] for line in text.splitlines()}
    settled, first = re.fullmatch(r"([0-9.]+) fps, begins with ([0-9.]+) fps", lines["after 30 min"]).groups()
    assert float(settled) < float(re.search(r"([0-9.]+) fps", lines["over all"])[1]) < float(first)
    assert re.match(r"1\.20 \(.*\) W, assumed: ", lines["of it base"])
    assert "lowered for heat" in lines["temperature"]
    assert text.count("throttled") == 1  # the column


def test_a_prediction_for_this_machine_is_of_a_run_without_a_cap(answer: Answer) -> None:
    free, capped = (
        answer("predict", "--profile", "host", "--size", "512", *more)
        for more in ((), ("--performance-profile", "sustained_high_performance"))
    )
    assert free["config"]["performance_profile"] == "burst"
    assert capped["config"]["performance_profile"] == "sustained_high_performance"
    assert free["fps"] > capped["fps"]
    assert "its speeds are assumed" in free["notes"][0]


def test_latest_is_the_same_in_predict_and_in_what_if(answer: Answer) -> None:
    """At the display's rate, that is: no frame is released faster than it can be shown."""
    document = answer("predict", "--policy", "latest", "--fps", "1000", "--what-if")
    row = next(row for row in document["alternatives"] if row["name"] == "latest, double")
    assert row["latency_ms"] == document["latency_ms"]["mean"]


def test_predict_draws_heat(tmp_path: Path, command: Command) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "heat.svg"
    command("predict", "--minutes", "5", "--plot", str(path))
    assert "<svg" in path.read_text()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("encoder,norm,size,channels,layout\n", "no rows"),
        ("encoder,norm,size,channels,layout,size\nresnet18,batch,512,16,packed,256\n", "column 'size' twice"),
        ("encoder,norm,size\nresnet18,batch,512\n", "no column channels, layout"),
        ("encoder,norm,size,channels,layout\nresnet18,batch,512\n", "line 2: found 3 cells"),
    ],
)
def test_a_bad_table_is_named_with_its_line(text: str, said: str, tmp_path: Path, command: Command) -> None:
    (tmp_path / "rows.csv").write_text(text)
    assert said in command("predict", "--table", str(tmp_path / "rows.csv"), code=2)[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("predict", "--profile", "nope"), ("nope", "snapdragon-888")),
        (("predict", "--profile", "phone-template"), ("template",)),
        (("predict", "--encoder", "vgg"), ("vgg", "resnet18")),
        (("predict", "--size", "500"), ("500", "32")),
        (("predict", "--channels", "0"), ("0", "1 to 16")),
        (("predict", "--policy", "warp"), ("warp", "pipelined")),
        (("predict", "--policy", "pipelined", "--edge", "octuple"), ("octuple", "double")),
        (("predict", "--performance-profile", "warp"), ("warp", "burst")),
        (("predict", "--table", "/nope.csv"), ("/nope.csv",)),
        (("predict", "--plot", "heat.bmp"), (".bmp", ".svg")),
        (("profiles", "show", "nope"), ("nope",)),
        (("profiles", "fit", "--from", "/nope.csv"), ("/nope.csv",)),
    ],
)
def test_wrong_usage_is_one_sentence_and_exit_code_2(
    arguments: tuple[str, ...], words: tuple[str, ...], command: Command
) -> None:
    out, err = command(*arguments, code=2)
    assert out == "" and "Traceback" not in err
    assert [word for word in words if word not in err] == []


def test_a_bad_profile_is_exit_code_2_with_file_and_key(tmp_path: Path, command: Command) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'extends = "snapdragon-888"\n[units.gpu]\nidle_w = { value = -1, kind = "assumed", source = "x" }\n'
    )
    for words in (("profiles", "check", str(path)), ("predict", "--profile", str(path))):
        assert f"{path}: units.gpu.idle_w: found -1, expected 0 to 1000" in command(*words, code=2)[1].replace("\n", "")


def test_profiles_are_listed_shown_and_checked(answer: Answer, command: Command) -> None:
    listed = answer("profiles", "list")["profiles"]
    assert {"snapdragon-888", "host", "agx-orin"} <= {row["name"] for row in listed}
    shown = answer("profiles", "show", "snapdragon-888")
    assert shown["units"]["gpu"]["efficiency"]["convolution"]["kind"] == "fitted"
    checked = answer("profiles", "check")
    assert checked["published"] and not any(row["independent"] for row in checked["published"])
    for name in ("list", "check"):
        command("profiles", name)
    assert "units.dsp.efficiency.convolution" in command("profiles", "show", "snapdragon-888")[0]
