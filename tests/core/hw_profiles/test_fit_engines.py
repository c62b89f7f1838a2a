"""The fit of tensor engines: it finds numbers that made the rows, and what it says of errors is of unseen networks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles.engine_study import (
    BEGIN,
    END,
    MARK,
    PROFILE_OF,
    ChipRate,
    errors_of,
    head_of,
    middle,
    own_error,
    study_engine,
    with_table,
)
from trilane.hw_profiles.fit_engines import (
    ALWAYS,
    COLUMNS,
    FACTORS,
    UNITS_OF_RATES,
    Fitted,
    Latency,
    LeftOut,
    Numbers,
    _cost,
    _derivatives,
    _Rows,
    as_stated,
    cross_validate,
    fit_anchors,
    fit_engine,
    folds,
    layers_of_rows,
    predict_rows,
    priors,
    rate_prior,
    read_latencies,
)
from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_time import interval, price
from trilane.hw_profiles.network_work import count_work
from trilane.hw_profiles.operators import INDEX, NAMES, RATES, Layers
from trilane.hw_profiles.profile_files import load_profile, profile_folder
from trilane.hw_profiles.reference_networks import NetworkSpec, network_work
from trilane.hw_profiles.schema import SIGMAS, corners_of
from trilane.hw_profiles.unit_times import nearest

SPECS = {
    f"{encoder}-{norm}-{side}": NetworkSpec(encoder, norm, side, side, 8)
    for encoder in ("resnet18", "mobilenetv2", "efficientnet-lite0")
    for norm in ("batch", "instance")
    for side in (64, 256)
}


@pytest.fixture(scope="module")
def layers() -> dict[str, Layers]:
    return {name: network_work(spec).layers for name, spec in SPECS.items()}


def rows_of(numbers: Numbers, layers: dict[str, Layers], chips: tuple[str, ...]) -> list[Latency]:
    """Rows that `numbers` made, without noise."""
    asked = [Latency(name, "unet", chip, "v73", "int8_tflite", 1.0) for name in layers for chip in chips]
    fitted = Fitted("int8_tflite", chips, numbers, numbers)
    return [row.row._replace(ms=row.predicted_ms) for row in predict_rows(fitted, asked, layers)]


def moved_priors(chips: tuple[str, ...]) -> Numbers:
    """Numbers half a spread away from what the priors say."""
    (factors, rates), (of_factors, of_rates) = priors("int8_tflite", chips)
    signs = np.where(np.arange(len(NAMES)) % 2, 0.5, -0.5)
    return Numbers(factors + signs * of_factors, rates + 0.5 * of_rates * np.where(np.arange(6) % 2, 1, -1))


def test_the_priors_predict_rows_of_the_priors_exactly(layers: dict[str, Layers]) -> None:
    mean, _ = priors("int8_tflite", ("8gen2",))
    fitted = fit_engine(rows_of(mean, layers, ("8gen2",)), layers)
    assert fitted.numbers.flat == pytest.approx(mean.flat, abs=1e-6)


def test_a_network_that_was_left_out_is_predicted_by_numbers_that_made_the_others(layers: dict[str, Layers]) -> None:
    truth = moved_priors(("8gen2", "8gen3"))
    rows = rows_of(truth, layers, ("8gen2", "8gen3"))
    out = frozenset(["mobilenetv2-batch-256"])
    mean, _ = priors("int8_tflite", ("8gen2", "8gen3"))
    before = predict_rows(Fitted("int8_tflite", ("8gen2", "8gen3"), mean, mean), rows, layers)
    after = cross_validate(rows, layers, mean, [out])
    assert {row.row.network for row in after} == out
    assert max(abs(row.error) for row in after) < 0.05 < max(abs(row.error) for row in before if row.row.network in out)


def test_one_row_that_is_far_off_moves_little(layers: dict[str, Layers]) -> None:
    """Ten times too slow, one of 24 rows: the others stay within some percent."""
    rows = rows_of(moved_priors(("8gen2", "8gen3")), layers, ("8gen2", "8gen3"))
    spoilt = [rows[0]._replace(ms=10 * rows[0].ms), *rows[1:]]
    errors = [abs(row.error) for row in predict_rows(fit_engine(spoilt, layers), rows[1:], layers)]
    assert float(np.median(errors)) < 0.03


def test_the_derivatives_are_those_of_the_cost(layers: dict[str, Layers]) -> None:
    chips = ("8gen2",)
    rows = rows_of(moved_priors(chips), layers, chips)
    data = _Rows(rows, layers, chips)
    mean, spread = (numbers.flat for numbers in priors("int8_tflite", chips))
    at = mean + np.where(spread > 1e-3, 0.1, 0)
    gradient, _ = _derivatives(at, data, mean, spread, 1)
    for index in (INDEX["depthwise"], INDEX["normalisation"], len(NAMES), len(NAMES) + 3, len(NAMES) + 5):
        step = np.zeros_like(at)
        step[index] = 1e-5
        slope = (_cost(at + step, data, mean, spread) - _cost(at - step, data, mean, spread)) / 2e-5
        assert 2 * gradient[index] == pytest.approx(slope, rel=1e-3)


def test_every_network_but_the_one_that_pins_the_rate_is_left_out_once() -> None:
    networks = [*"abcdefghijkl", ALWAYS]
    parts = list(folds(networks))
    assert len(parts) == 5
    assert sorted(name for part in parts for name in part) == sorted(set(networks) - {ALWAYS})
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_stated_rates_come_back() -> None:
    """1 TMAC/s is 1e-12 s a product; 2 bytes at 100 GB/s take 20 ps; 3 us are 3e-6 s."""
    assert as_stated("fp16_tflite", "arithmetic", 1e-12) == pytest.approx(1)
    assert as_stated("fp16_tflite", "spill", 2e-11) == pytest.approx(100)
    assert as_stated("int8_tflite", "job", 3e-6) == pytest.approx(3)
    mean, _ = priors("fp16_tflite", ("8gen3",))
    stated = Fitted("fp16_tflite", ("8gen3",), mean, mean).rates_of("8gen3")
    assert stated["weight_gb_s"].value == pytest.approx(rate_prior("fp16_tflite", "8gen3", "weight_gb_s").value)
    assert len(stated) == len(RATES)


def test_priors_are_there_for_every_term() -> None:
    assert set(NAMES) == {*FACTORS, *UNITS_OF_RATES}


def test_a_chip_known_by_two_networks(layers: dict[str, Layers]) -> None:
    """A chip half as fast again in everything, of which two rows are known: the others follow."""
    chips = ("8elite",)
    truth = moved_priors(chips)
    known = Fitted("int8_tflite", chips, truth, truth)
    faster = Numbers(truth.factors, truth.rates - math.log(1.5))
    rows = [row._replace(chip="8elite5") for row in rows_of(faster, layers, chips)]
    anchors = [row for row in rows if row.network in ("resnet18-batch-64", "resnet18-instance-256")]
    found = fit_anchors(known, "8elite", anchors, layers)
    errors = [abs(row.error) for row in predict_rows(found, rows, layers)]
    assert max(errors) < 0.1


def left_out(error: float, unsure: float) -> LeftOut:
    return LeftOut(Latency("n", "f", "c", "v73", "int8_tflite", 1.0), math.exp(error), unsure)


def test_the_models_own_error_makes_intervals_cover_four_fifths() -> None:
    """Errors of 1 to 10 hundredths without any doubt about numbers: the interval ends between the eighth and ninth."""
    rows = [left_out(sign * k / 100, 0.0) for k, sign in zip(range(1, 11), [1, -1] * 5, strict=True)]
    assert 0.08 <= SIGMAS * own_error(rows) <= 0.09
    assert own_error([left_out(0.05, 1.0)] * 3) == 0, "doubt about numbers covers them"
    halfway = [row._replace(unlike=0.5) for row in rows]
    assert own_error(halfway) == pytest.approx(2 * own_error(rows)), "it is that of a network wholly unlike"


def test_a_network_is_as_unlike_as_the_nearest_of_the_fit() -> None:
    """Half of its time goes into products, half into pools: 0.5 from one of products alone, 0.4 from the other."""
    engine = load_profile("hexagon").units["dsp"].engines["int8_tflite"]
    shares = np.zeros(len(NAMES))
    shares[[INDEX["convolution"], INDEX["pool"]]] = 0.5
    others = {"plain": {"convolution": 1.0}, "mixed": {"convolution": 0.1, "pool": 0.9}, "none": {"clip": 1.0}}
    assert nearest(engine.model_copy(update={"seen": others}), shares) == (pytest.approx(0.4), "mixed")
    assert nearest(engine.model_copy(update={"seen": {}}), shares) == (1.0, "")
    tables = {name: np.array([of.get(term, 0.0) for term in NAMES]) for name, of in others.items()}
    numbers, spreads = priors("int8_tflite", ("8gen2",))
    assert Fitted("int8_tflite", ("8gen2",), numbers, spreads, tables).unlike(shares) == pytest.approx(0.4)


def test_the_fit_knows_the_networks_that_it_has_seen(layers: dict[str, Layers]) -> None:
    numbers, _ = priors("int8_tflite", ("8gen2",))
    rows = rows_of(numbers, layers, ("8gen2",))
    fitted = fit_engine([row for row in rows if row.network != "resnet18-batch-64"], layers, numbers)
    assert set(fitted.seen) == set(layers) - {"resnet18-batch-64"}
    unlike = {row.row.network: row.unlike for row in predict_rows(fitted, rows, layers)}
    assert unlike.pop("resnet18-batch-64") > 0.01
    assert max(unlike.values()) < 1e-9


def test_errors_of_rows() -> None:
    rows = [left_out(math.log(1 + e), 0) for e in (-0.3, 0.1, 0.15, 0.2)]
    assert errors_of(rows) == pytest.approx({"rows": 4, "median": 0.175, "p90": 0.27, "close": 0.5, "bias": 0.125})


def test_the_middle_of_two_chips_is_geometric() -> None:
    """1 and 4: in the middle 2; they differ by a factor of 2 to either side, beside what is open of each."""
    (number,) = middle([{"x": ChipRate(1, 0.3, "fitted")}, {"x": ChipRate(4, 0.3, "fitted")}]).values()
    assert number == pytest.approx((2, math.hypot(math.log(2), 0.3)))


def test_a_table_goes_where_its_marks_are(tmp_path: Path) -> None:
    assert with_table(f"a\n{BEGIN}\nold\n{END}\nz\n", "new", tmp_path) == f"a\n{BEGIN}\nnew\n{END}\nz\n"
    with pytest.raises(BadInputError, match="no place"):
        with_table(f"a\n{BEGIN}\n", "new", tmp_path)


def test_the_head_of_a_profile_stays(tmp_path: Path) -> None:
    path = tmp_path / "chip.toml"
    path.write_text(f'name = "mine"\n\n\n{MARK}\n[x]\n')
    assert head_of(path) == 'name = "mine"\n\n'
    for name in PROFILE_OF.values():
        assert head_of(profile_folder() / f"{name}.toml").strip()


@pytest.fixture(scope="module")
def chips_folder(shared_data: Path) -> Path:
    folder = shared_data / "chips"
    if not (folder / "chip_rows.csv").is_file():
        pytest.skip("no published latencies in ../shared/data/chips")
    return folder


def test_rows_that_fell_off_the_engine_are_left_out(chips_folder: Path) -> None:
    """The README says so of the w8a8 DeepLabV3; PIDNet is an extra."""
    rows = read_latencies(chips_folder)
    assert not [row for row in rows if row.network == "pidnet" or row.ms > 1000]
    assert not [row for row in rows if row.network == "deeplabv3_resnet50" and row.engine.startswith("int8")]
    assert len({row.network for row in rows if row.engine == "int8_tflite"}) == 26
    assert sum(row.anchor for row in rows) == 2


ROW = "a,8gen1,v69,w8a8,tflite,1.5,,fit"


@pytest.mark.parametrize(
    ("networks", "columns", "row", "said"),
    [
        ("name,split", ",".join(COLUMNS), ROW, "networks.csv: found no column family"),
        ("name,split,family", "network,chip", "a,8gen1", "chip_rows.csv: found no column hexagon, precision"),
        ("name,split,family", ",".join(COLUMNS), ROW.replace("1.5", "fast"), "chip_rows.csv: line 2: ms: found 'fast'"),
        ("name,split,family", ",".join(COLUMNS), ROW.replace("1.5", "nan"), "line 2: ms: found 'nan'"),
        (
            "name,split,family",
            ",".join(COLUMNS),
            ROW.replace("w8a8", "w4"),
            "line 2: found w4, tflite, expected",
        ),
        ("name,split,family", ",".join(COLUMNS), "a,8gen1,v69", "line 2: found , , expected one of w8a8, tflite"),
    ],
)
def test_damaged_tables_of_published_times_are_refused(
    networks: str, columns: str, row: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "networks.csv").write_text(f"{networks}\na,fit,small\n")
    (tmp_path / "chip_rows.csv").write_text(f"{columns}\n{row}\n")
    with pytest.raises(BadInputError) as caught:
        read_latencies(tmp_path)
    assert said in str(caught.value)


def test_committed_profiles_are_near_the_rows_that_made_them(chips_folder: Path) -> None:
    """Five networks of five families on four chips, under burst; and each lies in its interval or near it."""
    errors, inside = [], []
    for chip in ("8gen1", "8gen2", "8gen3", "8elite"):
        profile = load_profile(PROFILE_OF[chip])
        for row in read_latencies(chips_folder):
            if (
                row.chip == chip
                and row.engine == "int8_tflite"
                and row.network in (*("resnet18", "mobilenet_v2", "ffnet_78s", "quicksrnetlarge", "unet_segmentation"),)
            ):
                work = count_work(read_graph(chips_folder / "networks" / f"{row.network}.onnx").model)
                time = price(profile, work, "dsp", corners_of(profile, "burst"))
                around = interval(profile, work, time)
                errors.append(abs(time.total_ms / row.ms - 1))
                inside.append(around.low_ms <= row.ms <= around.high_ms)
    assert len(errors) == 20
    assert float(np.median(errors)) <= 0.1
    assert np.mean(inside) >= 0.75


def test_two_chips_are_fitted_and_validated_in_seconds(chips_folder: Path) -> None:
    names = ("resnet18", "resnet101", "mobilenet_v2", "ffnet_40s", "quicksrnetlarge", "xlsr", ALWAYS)
    rows = [
        row
        for row in read_latencies(chips_folder)
        if row.engine == "int8_qnn_dlc" and row.chip in ("8gen2", "8gen3") and row.network in names
    ]
    layers = layers_of_rows(chips_folder, rows)
    assert layers.keys() == set(names)
    study = study_engine(rows, layers)
    assert {row.row.network for row in study.left_out} == set(names) - {ALWAYS}
    assert errors_of(predict_rows(study.fitted, rows, layers))["median"] < 0.1
    assert study.coverage >= 0.75
