"""A stage's time out of another tool's file: in a pipeline file, and written there by `trilane times`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import onnx
import pytest

from trilane.errors import BadInputError
from trilane.pipeline.pipeline_file import read_pipeline

Command = Callable[..., tuple[str, str]]
HUB = {"execution_summary": {"all_inference_times": [4000, 5000, 6000]}, "execution_detail": []}
LOG = "--graph=net.tflite\ncount=50 first=4000 curr=5000 min=3000 max=7000 avg=5000 std=500\n"
FILE = """# kept
[stages]
head = { unit = "gpu", time_ms = 1 }  # this too
tail = { unit = "dsp", in = "head", time_ms = %s }
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "in").mkdir()
    for where in (tmp_path, tmp_path / "in"):
        (where / "hub.json").write_text(json.dumps(HUB))
        (where / "log.txt").write_text(LOG)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(folder: Path, time: str) -> Path:
    path = folder / "in" / "file.toml"
    path.write_text(FILE % time)
    return path


def test_samples_or_mean_and_spread(folder: Path) -> None:
    tail = read_pipeline(written(folder, '{ from = "hub.json" }')).stages["tail"].time_ms
    assert tail is not None
    assert tail.samples == (4.0, 5.0, 6.0)
    tail = read_pipeline(written(folder, '{ from = "log.txt", name = "net.tflite" }')).stages["tail"].time_ms
    assert tail is not None
    assert (tail.mean, tail.sd, tail.samples) == (5.0, 0.5, ())


def test_a_change_by_hand_reads_it_too(folder: Path) -> None:
    file = read_pipeline(written(folder, "3")).changed(['stages.head.time_ms={ from = "hub.json" }'])
    head = file.stages["head"].time_ms
    assert head is not None
    assert head.mean_ms == 5.0


@pytest.mark.parametrize(
    ("time", "where", "found"),
    [
        ('{ from = "../hub.json" }', "stages.tail.time_ms", "a path inside the folder"),
        ('{ from = "/etc/passwd" }', "stages.tail.time_ms", "a path inside the folder"),
        ('{ from = "none.csv" }', "none.csv", "no such file"),
        ('{ from = "file.toml" }', "file.toml", "text that begins with '# kept'"),
        ('{ from = "hub.json", name = "all_inference_time" }', "stages.tail.time_ms", "did you mean"),
        ('{ name = "x" }', "stages.tail.time_ms", "from with or without name"),
        ('{ from = "hub.json", mean = 3 }', "stages.tail.time_ms", "from with or without name"),
        ('{ from = "hub.json", nam = "x" }', "stages.tail.time_ms", "did you mean 'name'"),
        ('{ from = 3 }', "stages.tail.time_ms", "string"),
    ],
)  # fmt: skip
def test_what_is_no_time_is_refused(time: str, where: str, found: str, folder: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        read_pipeline(written(folder, time))
    assert where in caught.value.where
    assert found in str(caught.value)


def test_the_only_run_or_a_name(folder: Path) -> None:
    two = {"execution_summary": {**HUB["execution_summary"], "estimated_inference_time": 4500}}  # type: ignore[dict-item]
    (folder / "in" / "hub.json").write_text(json.dumps(two))
    with pytest.raises(
        BadInputError, match=r"found 2 runs in hub\.json: 'all_inference_times', 'estimated_inference_time'"
    ):
        read_pipeline(written(folder, '{ from = "hub.json" }'))


OFFLINE = """MLPerf Results Summary
SUT name : snpe
Scenario : Offline
Mean latency (ns) : 12331497965
"""
SLICE = '[{"name": "seg", "ph": "X", "ts": 1, "dur": 4000}]'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            OFFLINE,
            "found no run in times, only 'snpe' (all samples at once (Offline)), expected one; "
            "measure one job at a time, such as LoadGen's SingleStream",
        ),
        (SLICE, "only 'seg' (slice, with what its thread waited for), expected one; give one with --name"),
        (
            LOG + LOG.replace("net", "other"),
            "2 runs in times: 'net.tflite', 'other.tflite', expected one; give one with",
        ),
    ],
)
def test_a_file_without_one_run_says_why(text: str, reason: str, folder: Path, command: Command) -> None:
    (folder / "times").write_text(text)
    written(folder, "3")
    _, err = command("times", "times", "--stage", "in/file.toml:tail", code=2)
    assert reason in " ".join(err.split())


def test_a_stage_is_written_and_all_else_stays(folder: Path, command: Command) -> None:
    """Beside the file the profile is named; from elsewhere its times are written out."""
    pytest.importorskip("tomlkit")
    path = written(folder, "3")
    command("times", "in/hub.json", "--stage", "in/file.toml:tail")
    assert path.read_text() == FILE % '{from = "hub.json", name = "all_inference_times"}'
    command("times", "hub.json", "--stage", "in/file.toml:tail")
    assert path.read_text() == FILE % "{samples = [4.0, 5.0, 6.0]}"
    command("times", "log.txt", "--name", "net.tflite", "--stage", "in/file.toml:tail")
    assert path.read_text() == FILE % "{mean = 5.0, sd = 0.5}"


def test_a_stage_may_lack_a_time_before(folder: Path, command: Command) -> None:
    pytest.importorskip("tomlkit")
    path = folder / "in" / "file.toml"
    path.write_text('[stages]\nhead = { unit = "gpu", time_ms = 1 }\ntail = { unit = "dsp", in = "head" }\n')
    command("times", "hub.json", "--stage", "in/file.toml:tail")
    tail = read_pipeline(path).stages["tail"].time_ms
    assert tail is not None
    assert tail.samples == (4.0, 5.0, 6.0)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ("stages = 3", "stages"),
        ("[stages]\ntail = 3", "stages.tail"),
        ('[stages]\nhead = { unit = "gpu" }\ntail = { unit = "dsp", in = "head" }', "stages.head"),
        ('[stages]\ntail = { unit = "dsp", tme = 1 }', "stages.tail"),
    ],
)
def test_other_faults_of_the_file_are_still_told(stages: str, message: str, folder: Path, command: Command) -> None:
    pytest.importorskip("tomlkit")
    (folder / "in" / "file.toml").write_text(stages)
    _, err = command("times", "hub.json", "--stage", "in/file.toml:tail", code=2)
    assert message in err
    assert (folder / "in" / "file.toml").read_text() == stages


def test_written_times_have_six_digits(folder: Path, command: Command) -> None:
    pytest.importorskip("tomlkit")
    (folder / "hub.json").write_text(json.dumps({"execution_summary": {"all_inference_times": [12511.299999999999]}}))
    path = written(folder, "3")
    command("times", "hub.json", "--stage", "in/file.toml:tail")
    assert path.read_text() == FILE % "{samples = [12.5113]}"
    (folder / "log.txt").write_text(LOG.replace("avg=5000", "avg=5000.00012").replace("std=500", "std=500.00009"))
    command("times", "log.txt", "--stage", "in/file.toml:tail")
    assert path.read_text() == FILE % "{mean = 5.0, sd = 0.5}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--stage", "in/file.toml:tial"), "did you mean 'tail'"),
        (("--stage", "file.toml"), "FILE.toml:STAGE"),
        (("--stage", "in/file.toml:tail", "--name", "x"), "the unknown measurement 'x'"),
        (("log.txt", "--stage", "in/file.toml:tail"), "2 files with such a time"),
        (("--rows", "rows.csv"), "the network that was measured"),
        (("--rows", "rows.csv", "--network", "../net.onnx"), "give --network its path from there"),
    ],
)
def test_a_wrong_wish_writes_nothing(options: tuple[str, ...], message: str, folder: Path, command: Command) -> None:
    if "--stage" in options:
        pytest.importorskip("tomlkit")
    path = written(folder, "3")
    _, err = command("times", "hub.json", *options, code=2)
    assert message in err
    assert path.read_text() == FILE % "3"
    assert not (folder / "rows.csv").exists()


@pytest.mark.usefixtures("folder")
def test_every_time_as_a_row_and_back(command: Command) -> None:
    command("times", "hub.json", "--csv", "samples.csv")
    out, _ = command("times", "samples.csv", "--json")
    (one,) = json.loads(out)["measurements"]
    assert (one["name"], one["kind"], one["samples_ms"]) == ("all_inference_times", "run", [4.0, 5.0, 6.0])
    assert one["file"] == "samples.csv"


def test_the_document(folder: Path, command: Command) -> None:
    (folder / "hub.json").write_text(json.dumps({"execution_summary": {"all_inference_times": [4000, -1, 6000]}}))
    document = json.loads(command("times", "hub.json", "log.txt", "--json")[0])
    first = document["measurements"][0]
    assert {
        key: first[key] for key in ("name", "kind", "unit", "count", "mean_ms", "p50_ms", "p95_ms", "samples_ms")
    } == {
        "name": "all_inference_times",
        "kind": "run",
        "unit": "us",
        "count": 2,
        "mean_ms": 5.0,
        "p50_ms": 5.0,
        "p95_ms": pytest.approx(5.9),
        "samples_ms": [4.0, 6.0],
    }
    reason = "the time is negative (-1)"
    assert document["refused"] == [
        {"row": "execution_summary.all_inference_times[1]", "reason": reason, "file": "hub.json"}
    ]


def test_the_table_says_what_each_time_contains(folder: Path, command: Command) -> None:
    (folder / "qnn.csv").write_text(
        "Msg Timestamp,Message,Time,Unit of Measurement,Timing Source,Event Level,Event Identifier\n"
        "0,BACKEND,1359,US,BACKEND,ROOT,Accelerator (execute) time\n"
        "0,NODE,109588,CYCLES,BACKEND,SUB-EVENT,matmul (cycles)\n"
        "0,EXECUTE,9308,US,BACKEND,ROOT,QNN (execute) time\n"
    )
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in command("times", "qnn.csv")[0].splitlines()]
    assert {cells[0]: cells[-1] for cells in rows if cells} == {
        "QNN (execute) time": "whole call, with all waiting",
        "Accelerator (execute) time": "accelerator",
        "matmul (cycles)": "cycles: a share, no time",
    }


def test_control_characters_of_a_name_are_written_out(folder: Path, command: Command) -> None:
    (folder / "log.txt").write_text(LOG.replace("net.tflite", "n\x1b[31m.tflite"))
    out, _ = command("times", "log.txt")
    assert "\x1b" not in out


LAYERED = {
    "execution_summary": {"all_inference_times": [1535.49999, 1535.49999]},
    "execution_detail": [{"name": name, "execution_time": 702, "compute_unit": "NPU"} for name in ("conv1", "conv2")],
}
CPU_LOG = "INFO: Created TensorFlow Lite XNNPACK delegate for CPU.\n"
GPU_LOG = "INFO: Explicitly applied GPU delegate, and the model graph will be completely executed by the delegate.\n"
QNN_LOG = "INFO: TfLiteQnnDelegate delegate: 30 nodes delegated out of 31 nodes\n"


@pytest.fixture
def table(folder: Path, tiny_float: onnx.ModelProto) -> Path:
    onnx.save(tiny_float, folder / "net.onnx")
    (folder / "hub.json").write_text(json.dumps(LAYERED))
    return folder / "rows.csv"


def test_a_layer_is_no_row_of_a_network(table: Path, command: Command) -> None:
    _, err = command("times", "hub.json", "--name", "conv1", "--rows", "rows.csv", "--network", "net.onnx", code=2)
    assert "--name: found 'conv1', a layer, the mean, expected the time of a whole run" in err
    assert "--name is one of 'all_inference_times'" in err
    assert not table.exists()


def test_cycles_are_no_row_of_a_network(folder: Path, table: Path, command: Command) -> None:
    columns = "Msg Timestamp,Message,Time,Unit of Measurement,Timing Source,Event Level,Event Identifier\n"
    rows = "1,ROOT,7784,US,BACKEND,ROOT,RPC (execute) time\n1,NODE,500,CYCLES,BACKEND,SUB-EVENT,conv (cycles)\n"
    (folder / "qnn.csv").write_text(columns + rows)
    (layer,) = (
        each["name"]
        for each in json.loads(command("times", "qnn.csv", "--json")[0])["measurements"]
        if each["unit"] == "cycles"
    )
    _, err = command("times", "qnn.csv", "--name", layer, "--rows", "rows.csv", "--network", "net.onnx", code=2)
    assert "only cycles" in err
    assert not table.exists()


def test_the_row_that_is_written_is_printed(table: Path, command: Command) -> None:
    """Its time with six digits; AI Hub says where each layer ran."""
    out, _ = command("times", "hub.json", "--rows", "rows.csv", "--network", "net.onnx", "--precision", "fp16")
    assert table.read_text().splitlines()[1] == "net.onnx,1.5355,dsp,fp16,tflite,hub.json: all_inference_times"
    assert out.splitlines()[-4:] == [
        "written: rows.csv",
        "row: net.onnx, 1.5355 ms, unit dsp, precision fp16, runtime tflite",
        "hub.json says: unit dsp",
        "assumed, as hub.json does not say it: runtime (--runtime)",
    ]


@pytest.mark.parametrize(
    ("said", "options", "unit", "line"),
    [
        (CPU_LOG, (), "cpu", "log.txt says: unit cpu"),
        (GPU_LOG + CPU_LOG, (), "gpu", "log.txt says: unit gpu"),
        (QNN_LOG + CPU_LOG, (), "dsp", "unit (--hardware), precision (--precision), runtime (--runtime)"),
        ("", (), "dsp", "unit (--hardware), precision (--precision), runtime (--runtime)"),
        (CPU_LOG, ("--hardware", "gpu"), "gpu", "does not say it: precision (--precision), runtime (--runtime)"),
    ],
)
def test_the_unit_is_what_the_log_says(
    said: str, options: tuple[str, ...], unit: str, line: str, folder: Path, table: Path, command: Command
) -> None:
    (folder / "log.txt").write_text(f"--graph=net.tflite\n{said}{LOG.splitlines()[1]}\n")
    out, _ = command("times", "log.txt", "--rows", "rows.csv", "--network", "net.onnx", *options)
    assert table.read_text().splitlines()[1] == f"net.onnx,5.0,{unit},int8,tflite,log.txt: net.tflite"
    assert line in out
    _, err = command("times", "log.txt", "--rows", "rows.csv", "--network", "net.onnx", *options, "--json")
    assert line in err
