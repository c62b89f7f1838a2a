"""Which trials a sweep has, in which order and by which names: by hand, and against itertools."""

from __future__ import annotations

import hashlib
import socket
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.apps.cli.sweep import print_summary
from trilane.apps.cli.sweep import sweep as sweep_command
from trilane.apps.cli.sweep_options import SweptCommand
from trilane.apps.sweep import definition as module
from trilane.apps.sweep import engines
from trilane.apps.sweep.definition import (
    Definition,
    Options,
    SweepKind,
    Trial,
    TrialClock,
    canonical,
    read_sweep,
    trials_of,
)
from trilane.apps.sweep.store import SweepSummary, TrialRecord
from trilane.errors import BadInputError

EXAMPLE = Path(__file__).resolve().parents[4] / "docs" / "examples" / "chip-sweep.toml"
RUN = ("run",)
AXES = {"size": ["128", "256"], "runtime": ["ort", "openvino", "qnn"]}


def typed(options: Options) -> list[str]:
    return [f"--{name}={value}" for name, value in options.items()]


def rows(definition: Definition) -> list[tuple[Any, ...]]:
    return [tuple(trial.options.values()) for trial in trials_of(definition, typed)]


def test_a_name_is_the_hash_of_the_canonical_configuration() -> None:
    text = '{"command":["run"],"options":{"hud":false,"latch":3.0,"scene":"größe","size":"128"}}'
    options = {"size": "128", "latch": 3.0, "scene": "größe", "hud": False}
    assert canonical(RUN, options) == text
    trial = Trial(RUN, options, ())
    assert trial.id == hashlib.sha256(text.encode()).hexdigest()[:16]
    assert Trial(RUN, options, (), 2).id == hashlib.sha256(f'{text[:-1]},"repeat":2}}'.encode()).hexdigest()[:16]


@settings(max_examples=30)
@given(st.dictionaries(st.text(min_size=1), st.integers() | st.text() | st.booleans(), max_size=5), st.randoms())
def test_a_name_does_not_depend_on_the_order_of_options(options: dict[str, Any], chance: Any) -> None:
    shuffled = list(options.items())
    chance.shuffle(shuffled)
    assert Trial(RUN, dict(shuffled), ("other", "words")).id == Trial(RUN, options, ()).id


def test_a_grid_a_list_and_repeats_by_hand() -> None:
    whole = [("128", "ort"), ("128", "openvino"), ("128", "qnn"), ("256", "ort"), ("256", "openvino"), ("256", "qnn")]
    assert rows(Definition(RUN, {}, AXES)) == whole
    side_by_side = {"size": ["128", "256"], "runtime": ["ort", "qnn"]}
    assert rows(Definition(RUN, {"frames": 8}, side_by_side, SweepKind.LIST)) == [(8, "128", "ort"), (8, "256", "qnn")]
    twice = trials_of(Definition(RUN, {"frames": 8}, repeats=2), typed)
    assert [trial.repeat for trial in twice] == [1, 2]
    in_turns = trials_of(Definition(RUN, {}, {"size": (64, 96)}, repeats=2), typed)
    assert [(trial.repeat, trial.options["size"]) for trial in in_turns] == [(1, 64), (1, 96), (2, 64), (2, 96)]
    assert twice[0].id == trials_of(Definition(RUN, {"frames": 8}), typed)[0].id != twice[1].id
    assert twice[0].line == "trilane run --frames=8 --json"


@settings(max_examples=30)
@given(st.lists(st.integers(1, 4), max_size=4), st.data())
def test_grids_are_products_and_draws_are_among_them(lengths: list[int], data: Any) -> None:
    axes = {f"axis{place}": [f"{place}.{value}" for value in range(count)] for place, count in enumerate(lengths)}
    whole = list(product(*axes.values()))
    assert rows(Definition(RUN, {}, axes)) == whole
    count, seed = data.draw(st.integers(1, len(whole))), data.draw(st.integers(0, 9))
    drawn = rows(Definition(RUN, {}, axes, SweepKind.RANDOM, count, seed))
    assert len(set(drawn)) == count
    assert drawn == [row for row in whole if row in drawn]
    assert drawn == rows(Definition(RUN, {}, axes, SweepKind.RANDOM, count, seed))


def test_another_seed_draws_others() -> None:
    axes = {"size": [str(side) for side in range(100)]}
    assert len({tuple(rows(Definition(RUN, {}, axes, SweepKind.RANDOM, 5, seed))) for seed in range(10)}) == 10


@pytest.mark.parametrize(
    ("definition", "found"),
    [
        (Definition(RUN, {}, {"size": []}), "axes.size: found no value"),
        (Definition(RUN, {"size": "1"}, {"size": ["1"]}), "an axis that is a fixed option too"),
        (Definition(RUN, {}, AXES, SweepKind.LIST), "2 of size, 3 of runtime"),
        (Definition(RUN, {}, {"size": ["1", "1"]}), "trilane run --size=1 --json twice"),
        (Definition(RUN, {}, AXES, SweepKind.RANDOM, 7), "found 7, expected 1 to 6"),
    ],
)
def test_axes_that_do_not_fit(definition: Definition, found: str) -> None:
    with pytest.raises(BadInputError, match=found):
        trials_of(definition, typed)


def test_too_many_trials_are_refused_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    huge = {f"axis{place}": list(range(1000)) for place in range(6)}
    with pytest.raises(BadInputError, match="1000000000000000000 trials, expected at most 100000"):
        trials_of(Definition(RUN, {}, huge), typed)
    assert len(rows(Definition(RUN, {}, huge, SweepKind.RANDOM, 3))) == 3
    monkeypatch.setattr(module, "MOST_TRIALS", 5)
    with pytest.raises(BadInputError, match="6 trials"):
        trials_of(Definition(RUN, {}, AXES), typed)


def test_values_are_what_the_command_makes_of_them() -> None:
    command = SweptCommand(RUN)
    tokens = ["walk-past", "--size", "128", "--size=0256", "--latch", "3", "--no-hud", "--hud", "--cores", "cpu=0"]
    assert command.values_of(tokens) == {
        "scene": ["walk-past"],
        "size": ["128", "0256"],
        "latch": [3.0],
        "hud": [False, True],
        "cores": [["cpu=0"]],
    }
    assert command.converted("frames", "08") == command.converted("frames", 8) == 8
    assert command.converted("policy", "latest") == "latest"
    options = {"scene": "a b", "hud": False, "pace": False, "cores": ["cpu=0", "gpu=1"], "edge": "-x", "frames": 8}
    words = ("a b", "--no-hud", "--cores", "cpu=0", "--cores", "gpu=1", "--edge=-x", "--frames", "8")
    assert command.words_of(options) == words
    assert SweptCommand(("bench", "raster")).converted("size", "512") == 512


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("run --sze 3", "unknown 'sze', expected an option of run; did you mean 'size'"),
        ("run --policy piplined", "'piplined', expected one of .*, pipelined.* did you mean 'pipelined'"),
        ("run --frames x", "--frames: found 'x', expected a whole number"),
        ("run --size", "--size without a value"),
        ("run --video=no", "'--video=no', expected --video without a value"),
        ("run --no-video=yes", "'--no-video=yes', expected --no-video without a value"),
        ("run --dashboard", "--dashboard, expected options of the trials; it waits for a person"),
        ("run --out x", "the sweep's own --out"),
        ("bench raster here", "'here'"),
    ],
)
def test_options_that_a_command_does_not_take(words: str, message: str) -> None:
    first, *rest = words.split(" --", 1)[0].split() if words.startswith("bench") else words.split()
    name = (first, rest.pop(0)) if first == "bench" else (first,)
    with pytest.raises(BadInputError, match=message):
        SweptCommand(name).values_of(rest)


@pytest.mark.parametrize(("words", "near"), [(("rum",), "run"), (("bench", "rastr"), "bench raster"), (("bench",), "")])
def test_commands_that_cannot_be_swept(words: tuple[str, ...], near: str) -> None:
    with pytest.raises(BadInputError, match=f"did you mean '{near}'" if near else "NAME being one of"):
        SweptCommand(words)


def test_the_values_of_a_file_have_its_name_where_they_are_wrong() -> None:
    command = SweptCommand(("predict",))
    with pytest.raises(BadInputError, match=r"a.toml: axes: performance-profile: found 'brst'.*did you mean 'burst'"):
        command.converted("performance-profile", "brst", "a.toml: axes")
    with pytest.raises(BadInputError, match=r"a.toml: options: what-if: found 'yes', expected true or false"):
        command.converted("what-if", "yes", "a.toml: options")
    with pytest.raises(BadInputError, match=r"unknown 'chanels'.* did you mean 'channels'"):
        command.converted("chanels", 4, "a.toml: axes")


def test_a_file_by_hand(tmp_path: Path) -> None:
    file = tmp_path / "chips.toml"
    file.write_text('command = "bench raster"\nrepeats = 3\n[options]\nsize = 64\n[axes]\nchannels = [4, 8]\n')
    found = read_sweep(file)
    assert (found.command, found.kind, found.repeats) == (("bench", "raster"), SweepKind.GRID, 3)
    assert (found.options, found.axes) == ({"size": 64}, {"channels": [4, 8]})


def test_the_example_is_a_sweep_of_sixty_trials() -> None:
    file = read_sweep(EXAMPLE)
    command = SweptCommand(file.command)
    axes = {name: [command.converted(name, value) for value in values] for name, values in file.axes.items()}
    trials = trials_of(Definition(command.words, file.options, axes), command.words_of)
    words = "--profile snapdragon-888 --policy pipelined --size 512 --channels 16 --unit gpu --edge triple"
    assert (len(trials), trials[-1].line) == (60, f"trilane predict {words} --json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "an empty file"),
        ("command", "no TOML"),
        ("kind = 'grid'", "command: found nothing"),
        ("command = ' '", "command: found nothing"),
        (
            "command = 'run'\nkind = 'gird'",
            "kind: found 'gird', expected one of grid, list, random; did you mean 'grid'",
        ),
        ("comand = 'run'", "comand: found an unknown key.*did you mean 'command'"),
        ("command = 'run'\nrepeats = 0", "repeats: found 0, expected 1 or more"),
        ("command = 'run'\nrepeats = true", "repeats: found True, expected a whole number"),
        ("command = 'run'\nseed = 3", "seed: found seed of a grid"),
        ("command = 'run'\naxes = 3", "axes: found 3"),
        ("command = 'run'\n[axes]\nsize = 3", "axes.size: found 3, expected a list"),
    ],
)
def test_files_that_are_no_sweep(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "sweep.toml"
    file.write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_sweep(file)


class TwoMachines:
    """What a cluster of Ray says that it has."""

    def __init__(self, **resources: float) -> None:
        self.cluster_resources = lambda: {"CPU": 4.0, **resources}


def test_machines_that_are_to_measure_have_the_resource_for_it() -> None:
    assert engines._resources(TwoMachines(), TrialClock.VIRTUAL) == {}
    assert engines._resources(TwoMachines(trilane_host_clock=2.0), TrialClock.HOST) == {"trilane_host_clock": 1}
    with pytest.raises(BadInputError, match="no machine with the resource trilane_host_clock"):
        engines._resources(TwoMachines(), TrialClock.HOST)


def test_a_worker_of_ray_measures_as_its_machine_would() -> None:
    machine = {"PATH": "/bin", "CUDA_VISIBLE_DEVICES": "1", "LD_PRELOAD": "x"}
    worker = {"PATH": "/bin", "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "RAY_JOB_ID": "f"}
    assert engines.restored(worker, machine) == {"PATH": "/bin", "CUDA_VISIBLE_DEVICES": "1", "RAY_JOB_ID": "f"}


def test_an_address_where_nobody_listens_is_found_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        engines._try_address(address)
    with pytest.raises(ConnectionRefusedError):
        engines._try_address(address)
    for known_to_ray_alone in ("", "auto", "local", "ray://127.0.0.1:1"):
        engines._try_address(known_to_ray_alone)


OF_SIZES = Definition(RUN, {}, {"size": [0]})


def ended(*trials: dict[str, Any]) -> SweepSummary:
    """A sweep whose trials ended with these keys of their records."""
    common = {"status": "done", "seconds": 1.0, "options": {"size": 0}}
    records = (TrialRecord.model_validate({"id": str(place), **common, **own}) for place, own in enumerate(trials))
    return SweepSummary(Path("s"), tuple(records), 0)


def test_a_summary_says_why_trials_failed(capsys: pytest.CaptureFixture[str]) -> None:
    ends = [("failed", "no [room]"), ("done", None), ("failed", "no [room]"), ("lost", "killed")]
    print_summary(ended(*({"status": status, "error": error} for status, error in ends)), OF_SIZES, "host")
    printed = capsys.readouterr().out
    assert printed.splitlines()[-2:] == ["2 failed: no [room]", "1 lost: killed"] and "worst" not in printed


def test_the_row_of_a_trial_on_a_busy_machine_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    busy_one = {"options": {"size": "128"}, "unsure": ["other programs took 27 %"]}
    print_summary(ended({"options": {"size": "96"}}, busy_one), OF_SIZES, "host")
    quiet, busy = (line for line in capsys.readouterr().out.splitlines() if "done" in line and "│" in line)
    assert "96" in quiet and "UNSURE" not in quiet
    assert "128" in busy and "done, UNSURE" in busy


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("kind = 'random'", "sweep.toml: count: found none"),
        ("[axes]\nsize = []", "sweep.toml: axes.size: found no value"),
    ],
)
def test_defects_that_are_found_late_name_the_file(tmp_path: Path, text: str, found: str) -> None:
    file = tmp_path / "sweep.toml"
    file.write_text(f"command = 'predict'\n{text}\n")
    with pytest.raises(BadInputError, match=found):
        sweep_command([str(file)], dry_run=True)


def test_a_prediction_of_a_pipeline_file_shows_its_variant(capsys: pytest.CaptureFixture[str]) -> None:
    pipelines = [{"what_if": "", "fps": 30.0}, {"what_if": "run.fps=60", "fps": 59.5}]
    trial = {"options": {"set": ["run.fps=60"]}, "result": {"pipelines": pipelines}}
    print_summary(ended(trial), Definition(("predict",), {}, {"set": [["run.fps=60"]]}), "virtual")
    assert "59.5" in capsys.readouterr().out
