"""A profile moved by a handful of own rows: it finds a faster chip, its derivatives are exact, it says its errors."""

from __future__ import annotations

import copy
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnx
import pytest

from trilane.apps.cli.profiles import _cells
from trilane.errors import BadInputError
from trilane.hw_profiles import calibrate as module
from trilane.hw_profiles.calibrate import (
    CHIP,
    NOISE,
    NU,
    Calibrated,
    CheckedRow,
    OwnRow,
    _derivatives,
    _EngineRow,
    calibrate,
    calibrate_tables,
    error_scale,
    is_own_table,
    misses,
    on_chip,
    prior_covariance,
    read_own_rows,
)
from trilane.hw_profiles.fit_engines import WORK, read_latencies
from trilane.hw_profiles.network_time import Interval, interval, price, spread_of
from trilane.hw_profiles.profile_files import load_profile, load_tables, parse_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, network_work
from trilane.hw_profiles.schema import KEY_OF_RATE, MOST_ERROR_SCALE, SIGMAS, Profile, corners_of
from trilane.units import BURST, UnitName

Command = Callable[..., tuple[str, str]]
CHIP_NAME = "snapdragon-8-gen-2"
WORKS = {
    "resnet18": WORK["resnet18"](),
    **{
        f"{encoder}-{side}": network_work(NetworkSpec(encoder, "batch", side, side, 8))
        for encoder in ("resnet18", "mobilenetv2")
        for side in (128, 512)
    },
}
MORE_WORKS = {
    f"{encoder}-{norm}": network_work(NetworkSpec(encoder, norm, 256, 256, 8))
    for encoder in ("resnet18", "mobilenetv2", "efficientnet-lite0")
    for norm in ("batch", "instance")
}


def row(
    network: str, ms: float = 1.0, unit: UnitName = "dsp", runtime: Any = "tflite", precision: str = "int8"
) -> OwnRow:
    return OwnRow(network, network, (WORKS | MORE_WORKS)[network], ms, unit, precision, runtime)


def priced(profile: Profile, asked: OwnRow) -> float:
    chip = on_chip(profile, asked)
    return price(chip, asked.work, asked.unit, corners_of(chip, BURST)).total_ms


def slower(data: dict[str, Any], factor: float) -> dict[str, Any]:
    """The tables of a chip whose engines take `factor` times as long in everything."""
    changed = copy.deepcopy(data)
    for engine in changed["units"]["dsp"]["engines"].values():
        for key, _ in KEY_OF_RATE.values():
            engine["rates"][key]["value"] *= factor if key.endswith("_us") else 1 / factor
    return changed


@pytest.fixture(scope="module")
def tables() -> tuple[dict[str, Any], Path]:
    return load_tables(CHIP_NAME)


def test_a_row_costs_what_the_profile_says(tables: tuple[dict[str, Any], Path]) -> None:
    """Also where the rates differ: the second implementation is `price` with a profile of those rates."""
    data, path = tables
    for asked in (row("resnet18"), row("mobilenetv2-512", runtime="qnn_dlc"), row("resnet18-128", precision="fp16")):
        mine = _EngineRow(parse_profile(data, path), asked)
        for factor in (1.0, 1.7):
            there = priced(parse_profile(slower(data, factor), path), asked)
            assert mine.predict(np.full(6, np.log(factor)))[0] == pytest.approx(there, rel=1e-9)


def test_derivatives_are_those_of_the_cost(tables: tuple[dict[str, Any], Path]) -> None:
    """By differences: the gradient of half the cost."""
    rows = [_EngineRow(parse_profile(*tables), row(name, 0.7)) for name in WORKS]
    precision = np.linalg.inv(prior_covariance(["int8_tflite"]))
    at, places, step = np.linspace(-0.3, 0.4, 6), [0] * len(rows), 1e-5

    def cost(point: Any) -> float:
        return _derivatives(point, rows, places, precision)[0]

    found = _derivatives(at, rows, places, precision)[1]
    moved = [(cost(at + step * unit) - cost(at - step * unit)) / 4 / step for unit in np.eye(6)]
    assert found == pytest.approx(moved, rel=1e-5)


def test_the_prior_lets_all_rates_move_together() -> None:
    """Of two engines: all share the chip's speed, less is shared by a rate, an engine, and both."""
    found = prior_covariance(["int8_tflite", "fp16_tflite"])
    assert found[0, 0] == pytest.approx(1 + 0.04 + 0.04 + 0.0225)
    assert found[0, 1] == pytest.approx(1 + 0.04)  # another rate of the engine
    assert found[0, 6] == pytest.approx(1 + 0.04)  # the same rate of the other engine
    assert found[0, 7] == pytest.approx(1)
    assert (np.linalg.eigvalsh(found) > 0).all()


@pytest.mark.parametrize("factor", [0.5, 2.2])
def test_a_chip_that_is_faster_in_everything_is_found(factor: float, tables: tuple[dict[str, Any], Path]) -> None:
    """Five rows of one engine, without noise: every row left out, and an engine without rows, are met closely."""
    data, path = tables
    there = parse_profile(slower(data, factor), path)
    rows = [row(name)._replace(ms=priced(there, row(name))) for name in WORKS]
    moved = calibrate_tables(data, path, rows)
    assert median(abs(each.error_before) for each in moved.rows) == pytest.approx(abs(1 / factor - 1), rel=0.01)
    assert max(abs(each.error_after) for each in moved.rows) < 0.03
    assert all(each.after.low_ms < each.row.ms < each.after.high_ms for each in moved.rows)
    other = row("resnet18-512", runtime="qnn_dlc")
    assert priced(parse_profile(moved.data, path), other) == pytest.approx(priced(there, other), rel=0.05)


def test_one_row_that_is_far_off_moves_little(tables: tuple[dict[str, Any], Path]) -> None:
    data, path = tables
    profile = parse_profile(data, path)
    rows = [row(name)._replace(ms=priced(profile, row(name)) * (10 if name == "resnet18" else 1)) for name in WORKS]
    moved = parse_profile(calibrate_tables(data, path, rows).data, path)
    for each in rows[1:]:
        assert priced(moved, each) == pytest.approx(each.ms, rel=0.12)


def test_a_row_left_out_is_predicted_by_the_others_alone(tables: tuple[dict[str, Any], Path]) -> None:
    """Two equal networks contradict each other: each is predicted as the other was measured, not in between.

    Two rows of one network tell nothing of each other, as a fit must predict networks that it has not met.
    """
    data, path = tables
    ms = priced(parse_profile(data, path), row("resnet18"))
    rows = [row("resnet18", ms), row("resnet18", 2 * ms)]
    first, second = calibrate_tables(data, path, [rows[0], rows[1]._replace(network="equal")]).rows
    assert first.after_ms == pytest.approx(2 * ms, rel=0.03)
    assert second.after_ms == pytest.approx(ms, rel=1e-6)
    assert [each.after_ms for each in calibrate_tables(data, path, rows).rows] == pytest.approx([ms, ms], rel=1e-6)


def test_a_unit_without_an_engine_has_one_factor() -> None:
    """With rows that agree, log f = n w / (n w + s^2) log 3, where w = (NU + 1) / (NU + (log 3 - log f)^2 / s^2)."""
    data, path = load_tables("snapdragon-8-gen-3")
    profile = parse_profile(data, path)
    rows = [row(name, unit="gpu", precision="fp16") for name in ("resnet18-128", "resnet18-512", "mobilenetv2-512")]
    rows = [each._replace(ms=3 * priced(profile, each)) for each in rows]
    noise, there = max(NOISE, profile.units["gpu"].model_error_fraction.or_else(0.3)), 0.0
    for _ in range(200):
        weight = 3 * (NU + 1) / (NU + ((np.log(3) - there) / noise) ** 2) / noise**2
        there = weight * np.log(3) / (weight + 1 / CHIP**2)
    moved = parse_profile(calibrate_tables(data, path, rows).data, path)
    for each in rows:
        assert priced(moved, each) / priced(profile, each) == pytest.approx(np.exp(there), rel=1e-6)


def test_the_scale_of_the_error_by_hand() -> None:
    """Without misses t has one degree of freedom, so its quantile is tan(0.4 pi). Misses of 2 and -1: the variance is
    (1 + 4 + 1) / 3, and t of three degrees is within 1.6377 with 80 % (tables of Student's t)."""
    assert error_scale([]) == pytest.approx(np.tan(0.4 * np.pi) / SIGMAS)
    assert error_scale([2, -1]) == pytest.approx(1.6377 * np.sqrt(2) / SIGMAS, rel=1e-4)
    assert error_scale([1.0] * 1000) == pytest.approx(1, rel=2e-3)
    assert error_scale([1e6, 1e6]) == MOST_ERROR_SCALE


@pytest.mark.parametrize("rows", [1, 2, 5, 20])
def test_intervals_of_chips_of_the_stated_model_hold_in_80_of_100(rows: int) -> None:
    """A chip's variance is drawn as 1 / chi-square of one degree, and its misses are normal. Whatever was told, the
    interval then holds with 80 %, so chips whose scale ends at the limit can be left out. The bound is four deviations
    of the binomial distribution."""
    rng, chips = np.random.default_rng(rows), 20_000
    deviations = 1 / np.abs(rng.standard_normal(chips))
    told, new = rng.standard_normal((rows, chips)) * deviations, rng.standard_normal(chips) * deviations
    scales = np.array([error_scale(list(each)) for each in told.T])
    free = scales < MOST_ERROR_SCALE
    inside = np.abs(new[free]) <= SIGMAS * scales[free]
    assert free.mean() > 0.8
    assert abs(inside.mean() - 0.8) < 4 * np.sqrt(0.16 / free.sum())


def around(low: float, high: float) -> Interval:
    return Interval(low, high, ())


def test_misses_are_those_of_other_rows_of_the_unit() -> None:
    """Twice as long as predicted, and the interval ends at twice the prediction: SIGMAS stated errors."""
    two = CheckedRow(row("resnet18", 4.0), 1.0, around(1, 1), 2.0, around(1, 4))
    same = CheckedRow(row("resnet18-128", 2.0), 1.0, around(1, 1), 2.0, around(1, 4))
    lonely = CheckedRow(row("resnet18", 9.0, unit="gpu"), 1.0, around(1, 1), 2.0, around(1, 4))
    left_out = [two, same, lonely]
    assert misses(left_out, "dsp") == pytest.approx([SIGMAS, 0])
    assert misses(left_out, two) == [0]
    assert misses(left_out, same) == pytest.approx([SIGMAS])
    assert misses(left_out, "gpu") == [] == misses(left_out, lonely)
    assert misses([two, two, same], "dsp") == pytest.approx([SIGMAS, 0])
    assert misses([two, two], "dsp") == []


def test_the_moved_profile_states_the_scaled_error(tables: tuple[dict[str, Any], Path]) -> None:
    """Its intervals are `error_scale` times as wide as those of the same profile without."""
    data, path = tables
    rows = [row(name, 1.0 + place) for place, name in enumerate(WORKS)]
    moved = calibrate_tables(data, path, rows)
    scale, spread = moved.numbers["units.dsp.error_scale"]
    assert scale > 1 and spread == pytest.approx(np.sqrt(1 / 12))
    without = copy.deepcopy(dict(moved.data))
    del without["units"]["dsp"]["error_scale"]
    asked = row("resnet18-512", runtime="qnn_dlc")
    wide, narrow = (stated(parse_profile(each, path), asked) for each in (moved.data, without))
    assert spread_of(wide) == pytest.approx(scale * spread_of(narrow))
    assert any(f"by {scale:.2g}" in reason for reason in wide.why) and len(wide.why) == len(narrow.why) + 1


def test_a_scale_that_the_profile_states_counts(tables: tuple[dict[str, Any], Path]) -> None:
    """Rows as predicted have no misses, so what is left is the statement: twice the scale if it said 2."""
    data, path = tables
    told = copy.deepcopy(data)
    told["units"]["dsp"]["error_scale"] = {"value": 2.0, "kind": "assumed", "source": "a test"}
    rows = [row(name)._replace(ms=priced(parse_profile(data, path), row(name))) for name in WORKS]
    scales = [calibrate_tables(each, path, rows).numbers["units.dsp.error_scale"][0] for each in (data, told)]
    assert scales == pytest.approx([error_scale([0] * 5), 2 * error_scale([0] * 5)])


def stated(profile: Profile, asked: OwnRow) -> Interval:
    chip = on_chip(profile, asked)
    return interval(chip, asked.work, price(chip, asked.work, asked.unit, corners_of(chip, BURST)))


@pytest.mark.parametrize("times", [0.7, 1, 2])
def test_a_chip_drawn_from_the_prior_lies_in_its_intervals(times: float, tables: tuple[dict[str, Any], Path]) -> None:
    """Its rates are drawn from the prior, and its rows are off by so many times the stated error, which the fit is not
    told. By hand for 0.7: the scale is ((1 + 5 * 0.49) / 6)^(1/2) = 0.76, and t of six degrees is within 1.44, so the
    interval ends at 1.56 deviations, which is 88 %."""
    data, path = tables
    rng, engine = np.random.default_rng(8), "int8_tflite"
    root = np.linalg.cholesky(prior_covariance([engine]))
    names, held = [*WORKS, *MORE_WORKS], []
    for _ in range(30):
        chip = copy.deepcopy(data)
        rates = chip["units"]["dsp"]["engines"][engine]["rates"]
        for (key, _), deviation in zip(KEY_OF_RATE.values(), root @ rng.standard_normal(6), strict=True):
            rates[key]["value"] *= np.exp(deviation if key.endswith("_us") else -deviation)
        there = parse_profile(chip, path)
        rows = []
        for name in names:
            noise = times * spread_of(stated(there, row(name))) * rng.standard_normal()
            rows.append(row(name, priced(there, row(name)) * float(np.exp(noise))))
        order = rng.permutation(len(rows))
        moved = parse_profile(calibrate_tables(data, path, [rows[place] for place in order[:5]]).data, path)
        for place in order[5:]:
            span = stated(moved, rows[place])
            held.append(span.low_ms <= rows[place].ms <= span.high_ms)
    assert 0.7 <= np.mean(held) <= 0.9


TABLE = "network,ms,precision,runtime\n"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (TABLE + "a,1,int8,tflite\n", "found 1 rows, expected 2 to 1000"),
        (TABLE + "a,0,int8,tflite\n" * 2, "line 2: ms: found '0'"),
        (TABLE + "a,nan,int8,tflite\n" * 2, "line 2: ms: found 'nan'"),
        (TABLE + "a,1e9,int8,tflite\n" * 2, "line 2: ms: found '1e9'"),
        (TABLE + "a,1,int4,tflite\n" * 2, "line 2: precision: found 'int4'"),
        (TABLE + "a,1,int8,tflit\n" * 2, "did you mean 'tflite'?"),
        (TABLE + "a,1,int8\n" * 2, "line 2: found 3 cells, expected 4"),
        (TABLE + "../a,1,int8,tflite\n" * 2, "line 2: network: found '../a'"),
        (TABLE + "/a,1,int8,tflite\n" * 2, "line 2: network: found '/a'"),
        (TABLE + "a,1,int8,tflite\n" * 2, "a.onnx: found no such file"),
        (
            "# own\nmodel,time\n" + "a,1\n" * 2,
            "line 2: found the columns 'model,time', expected network and ms, and maybe",
        ),
        ("network;ms\n" + "a;1\n" * 2, "separate cells by commas"),
        ("network,ms,ms\n" + "a,1,2\n" * 2, "line 1: found column 'ms' twice"),
    ],
)
def test_wrong_tables_are_refused(text: str, found: str, tmp_path: Path) -> None:
    path = tmp_path / "own.csv"
    path.write_text(text)
    with pytest.raises(BadInputError) as caught:
        read_own_rows(path, tmp_path)
    assert found in str(caught.value)


@pytest.mark.parametrize(
    ("text", "is_own"),
    [("# own\n\nencoder,norm\n", False), (" \nnetwork,ms\n", True), ("# nothing\n", True)],
)
def test_the_header_says_whose_table_it_is(text: str, is_own: bool, tmp_path: Path) -> None:
    """Blank lines and comments may stand before it."""
    path = tmp_path / "table.csv"
    path.write_text(text)
    assert is_own_table(path) == is_own


@pytest.mark.parametrize("header", ["model,time", "network;ms", "ms"])
def test_the_command_names_the_columns_of_this_format(header: str, tmp_path: Path, command: Command) -> None:
    (tmp_path / "own.csv").write_text(header + "\n1\n2\n")
    _, err = command("profiles", "fit", "--from", str(tmp_path / "own.csv"), code=2)
    assert "network and ms, and maybe unit, precision, runtime" in err and "encoder" not in err


def checked(place: str, ms: float, before_ms: float, silent: bool = False) -> CheckedRow:
    asked = row("resnet18", ms)._replace(place=place, silent=silent)
    return CheckedRow(asked, before_ms, around(1, 1), 1.0, around(1, 1))


@pytest.mark.parametrize(
    ("ms", "said"),
    [
        (9.9, None),
        (0.11, None),
        (70.0, "line 5: 70 ms is 70 times what the rows suggest; is it of this network and unit?"),
        (700.0, "line 5: 700 ms is 700 times what the rows suggest; is it in us?"),
        (0.001, "line 5: 0.001 ms is 1/1000 of what the rows suggest; is it in s?"),
    ],
)
def test_a_row_of_another_scale_is_named(ms: float, said: str | None) -> None:
    """The others take as long as predicted, so the median of the four ratios is 1."""
    rows = (checked("line 2", 2.0, 2.0), checked("line 3", 4.0, 4.0), checked("line 4", 1.0, 1.0))
    assert Calibrated({}, {}, (*rows, checked("line 5", ms, 1.0))).notes == ([] if said is None else [said])


def test_rows_without_a_precision_are_named_where_the_network_is_of_floats(
    tiny_float: onnx.ModelProto, tmp_path: Path
) -> None:
    onnx.save(tiny_float, tmp_path / "a.onnx")
    (tmp_path / "own.csv").write_text("network,ms,precision\na,1,\na,1,int8\na,1,\n")
    rows = read_own_rows(tmp_path / "own.csv", tmp_path)
    assert [(each.precision, each.silent) for each in rows] == [("int8", True), ("int8", False), ("int8", True)]
    told = "counted as int8, though the network's file is of floats"
    for silent, said in (
        (rows, f"2 rows without a precision are {told}"),
        (rows[:2], f"1 row without a precision is {told}"),
    ):
        notes = Calibrated({}, {}, tuple(CheckedRow(each, 1, around(1, 1), 1, around(1, 1)) for each in silent)).notes
        assert notes == [said]


def test_the_printed_command_predicts_as_the_rows_were_counted(
    tiny_float: onnx.ModelProto, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rehearsal: the command that the fit prints gives the moved profile's time of the first row in int8."""
    monkeypatch.chdir(tmp_path)
    onnx.save(tiny_float, tmp_path / "a.onnx")
    (tmp_path / "own.csv").write_text("network,ms\na,0.0754\na,0.0754\n")
    out, _ = command("profiles", "fit", "--from", "own.csv", "--profile", CHIP_NAME, "--write", "my chip.toml")
    assert "note: 2 rows without a precision are counted as int8" in out
    assert "-0 %" not in out
    *_, written, predict = out.splitlines()
    assert written == "written: my chip.toml"
    assert predict == "predict: trilane predict --network a.onnx --profile 'my chip.toml' --precision w8a8"
    mine = load_profile("my chip.toml")
    assert (mine.name, mine.title.split(",")[0]) == ("my-chip", "my-chip: own measurements")
    (answer,) = json.loads(command(*shlex.split(predict)[2:], "--json")[0])["networks"]
    asked = read_own_rows(tmp_path / "own.csv", tmp_path)[0]
    assert answer["precision"] == "int8"
    assert answer["network_ms"] == pytest.approx(priced(mine, asked))
    assert answer["network_ms"] == pytest.approx(0.0754, rel=0.2)


def test_no_error_is_minus_nothing() -> None:
    assert _cells(checked("line 2", 1.0, 0.999))[4] == "+0 %"


def test_a_row_that_the_profile_cannot_predict_names_its_line() -> None:
    asked = row("resnet18", precision="fp32")
    with pytest.raises(BadInputError, match="line 3: found tflite for the dsp"):
        calibrate(CHIP_NAME, [row("resnet18"), asked._replace(place="line 3")])


def test_the_command_fits_and_writes(tmp_path: Path, shared_data: Path, command: Command) -> None:
    """Five published rows of the 8 Elite on the profile of the 8 Gen 2: the command's errors, and its profile's."""
    names = ("resnet18", "mobilenet_v2", "quicksrnetlarge", "regnet", "resnet101")
    known = {each.network: each.ms for each in elite(shared_data)}
    table = tmp_path / "own.csv"
    table.write_text("network,ms,precision\n" + "".join(f"{name},{known[name]},w8a8\n" for name in names))
    mine = tmp_path / "mine.toml"
    words = ("--from", str(table), "--networks", str(shared_data / "chips/networks"), "--profile", CHIP_NAME)
    out, _ = command("profiles", "fit", *words, "--name", "mine", "--write", str(mine), "--json")
    document = json.loads(out)
    assert [each["network"] for each in document["rows"]] == list(names)
    assert document["median_error_left_out"] < document["median_error_before"] / 2
    networks = shared_data / "chips/networks"
    others = [each for each in elite(shared_data) if each.network not in names]
    errors: dict[str, list[float]] = {}
    for profile in (CHIP_NAME, str(mine)):
        chip = load_profile(profile)
        for each in others:
            graph = module.read_graph(networks / f"{each.network}.onnx")
            asked = OwnRow("", each.network, graph.work, each.ms, "dsp", "int8", "tflite")
            errors.setdefault(profile, []).append(abs(priced(chip, asked) / each.ms - 1))
    before, after = (median(found) for found in errors.values())
    assert after <= before / 2


def elite(shared_data: Path) -> list[Any]:
    rows = read_latencies(shared_data / "chips")
    return [each for each in rows if each.chip == "8elite" and each.engine == "int8_tflite"]
