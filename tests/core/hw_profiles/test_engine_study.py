"""What is made of a fit of tensor engines: which rows it sees, what is assumed, and what is written, by hand."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles import engine_study
from trilane.hw_profiles.engine_study import (
    BEGIN,
    END,
    MARK,
    ChipRate,
    EngineStudy,
    Study,
    as_markdown,
    misses_of,
    plot_errors,
    profile_texts,
    study_engines,
)
from trilane.hw_profiles.fit_engines import (
    FACTORS,
    ON_CHIP_MB,
    UNITS_OF_RATES,
    Fitted,
    Latency,
    LeftOut,
    Numbers,
    Prior,
    factor_prior,
    rate_prior,
    read_latencies,
)
from trilane.hw_profiles.operators import NAMES, RATES, TERMS
from trilane.hw_profiles.schema import SIGMAS, EngineName

KEYS = ("arithmetic_tmac_s", "activation_gb_s", "spill_gb_s", "weight_gb_s", "operator_us", "job_us")
COLUMNS = "network,chip,hexagon,precision,runtime,ms,caution,use"
ROWS = """\
net,8gen2,v73,w8a8,tflite,1.5,,fit
net,8gen3,v75,w8a8,qnn_dlc,1.25,,fit
net,8gen2,v73,float,tflite,4,,fit
net,8gen2,v73,float,qnn_dlc,3,,fit
net,8elite,v79,w8a8,tflite,1,,fit
net,8elite5,v81,w8a8,tflite,0.75,,anchor
net,865,v66,w8a8,tflite,9,,fit
net,8gen2,v73,w8a8,tflite,7,3 layers on the CPU,fit
net,8gen2,v73,w8a8,tflite,1700,over 1 s,fit
more,8gen2,v73,w8a8,tflite,2,once only,fit
odd,8gen2,v73,w8a8,tflite,3,,fit
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "networks.csv").write_text("name,family,split\nnet,cnn,train\nmore,unet,test\nodd,cnn,extra\n")
    (tmp_path / "chip_rows.csv").write_text(f"{COLUMNS}\n{ROWS}")
    return tmp_path


def test_rows_are_read_by_hand(folder: Path) -> None:
    assert read_latencies(folder) == [
        Latency("net", "cnn", "8gen2", "v73", "int8_tflite", 1.5),
        Latency("net", "cnn", "8gen3", "v75", "int8_qnn_dlc", 1.25),
        Latency("net", "cnn", "8gen2", "v73", "fp16_tflite", 4.0),
        Latency("net", "cnn", "8gen2", "v73", "fp16_qnn_dlc", 3.0),
        Latency("net", "cnn", "8elite", "v79", "int8_tflite", 1.0),
        Latency("net", "cnn", "8elite5", "v81", "int8_tflite", 0.75, anchor=True),
        Latency("net", "cnn", "865", "v66", "int8_tflite", 9.0),
        Latency("more", "unet", "8gen2", "v73", "int8_tflite", 2.0),
    ]


def test_a_folder_without_the_tables_is_refused(folder: Path) -> None:
    wrong = {
        COLUMNS: "no row below",
        f"{COLUMNS.replace('use', 'used')}\n{ROWS}": "no column use, expected the columns",
    }
    for text, said in wrong.items():
        (folder / "chip_rows.csv").write_text(text)
        with pytest.raises(BadInputError, match=said):
            read_latencies(folder)
    (folder / "networks.csv").unlink()
    with pytest.raises(BadInputError, match=r"networks\.csv: found no such file, expected a CSV file"):
        read_latencies(folder)


def numbers_of(engine: EngineName, chips: Sequence[str], faster: float = 1.0) -> Fitted:
    """As the priors say, with factors of 3 and spreads of 0.25; rates so many times as large."""
    units = {"arithmetic": 1e-12, "operator": 1e-6, "job": 1e-6}
    rates = np.zeros((len(chips), len(RATES)))
    for row, chip in enumerate(chips):
        for column, (rate, key) in enumerate(zip(RATES, KEYS, strict=True)):
            value, cost = rate_prior(engine, chip, key).value, rate in ("operator", "job")
            size = 2 if engine.startswith("fp16") and rate != "arithmetic" else 1
            seconds = value * units[rate] * faster if cost else size * units.get(rate, 1e-9) / value / faster
            rates[row, column] = math.log(seconds)
    spreads = Numbers(np.full(len(NAMES), 0.25), np.full(rates.shape, 0.125))
    return Fitted(engine, tuple(chips), Numbers(np.log(np.full(len(NAMES), 3.0)), rates), spreads)


def left_out(engine: EngineName, chip: str, family: str, error: float, unsure: float = 0.0) -> LeftOut:
    return LeftOut(Latency("n", family, chip, "v73", engine, 2.0), 2.0 * (1 + error), unsure)


@pytest.fixture
def studied(monkeypatch: pytest.MonkeyPatch, folder: Path) -> tuple[Study, list[Any]]:
    """A study of the folder whose fits are told, and what they were asked for."""
    asked: list[Any] = []

    def study_engine(rows: Sequence[Latency], layers: Any) -> EngineStudy:
        asked.append((rows[0].engine, [(row.network, row.chip) for row in rows], layers))
        engine = rows[0].engine
        fitted = numbers_of(engine, sorted({row.chip for row in rows} | {"sa8295p"}))
        return EngineStudy(fitted, (left_out(engine, "8gen2", "cnn", 0.1),), 0.1)

    def fit_anchors(fitted: Fitted, before: str, rows: Sequence[Latency], layers: Any) -> Fitted:
        asked.append((fitted.engine, before, [(row.network, row.chip) for row in rows], layers))
        return numbers_of(fitted.engine, ["8elite5"], 2.0)

    monkeypatch.setattr(engine_study, "layers_of_rows", lambda where, rows: (where, {row.chip for row in rows}))
    monkeypatch.setattr(engine_study, "study_engine", study_engine)
    monkeypatch.setattr(engine_study, "fit_anchors", fit_anchors)
    return study_engines(folder), asked


def test_each_engine_is_fitted_to_its_own_rows(studied: tuple[Study, list[Any]], folder: Path) -> None:
    """Not to those of the 865, nor to anchors, which are fitted after the others."""
    study, asked = studied
    layers = folder, {"8gen2", "8gen3", "8elite", "8elite5"}
    assert asked == [
        ("int8_tflite", [("net", "8gen2"), ("net", "8elite"), ("more", "8gen2")], layers),
        ("int8_qnn_dlc", [("net", "8gen3")], layers),
        ("fp16_tflite", [("net", "8gen2")], layers),
        ("fp16_qnn_dlc", [("net", "8gen2")], layers),
        ("int8_tflite", "8elite", [("net", "8elite5")], layers),
    ]
    assert list(study.engines) == ["int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc"]
    assert study.chips == ("8elite", "8elite5", "8gen2", "8gen3", "sa8295p")
    for key in KEYS:
        prior = rate_prior("int8_tflite", "8gen2", key)
        assert study.rates["8gen2", "int8_tflite"][key] == pytest.approx((prior.value, 0.125, "fitted"))
        twice = rate_prior("int8_tflite", "8elite5", key).value * 2
        assert study.rates["8elite5", "int8_tflite"][key].value == pytest.approx(twice)


def rates(value: float, kind: str = "fitted") -> dict[str, ChipRate]:
    return {key: ChipRate(value * (number + 1), 0.5, kind) for number, key in enumerate(KEYS)}


ALL: tuple[EngineName, ...] = ("int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc")


def test_what_no_row_tells_is_assumed_of_a_relative() -> None:
    """The QCS6490 is half as fast as the SA8295P in the one engine in which both are known, so in the others too.

    In FP16 under one runtime it is compared under the other one first. Nothing is said where the relative is not known.
    """
    known: dict[tuple[str, EngineName], Any] = {
        ("qcs6490", "int8_tflite"): rates(2.0),
        ("sa8295p", "int8_tflite"): rates(4.0),
        ("sa8295p", "int8_qnn_dlc"): rates(5.0),
        ("sa8295p", "fp16_qnn_dlc"): rates(7.0),
        ("xelite", "fp16_tflite"): rates(3.0),
        ("xelite", "int8_tflite"): rates(30.0),
        ("8gen2", "fp16_tflite"): rates(1.0),
        ("8gen2", "int8_tflite"): rates(1.0),
        ("8gen2", "fp16_qnn_dlc"): rates(10.0),
        ("8elite5", "int8_tflite"): rates(1.0),
    }
    found = engine_study._assumed(known, ALL)
    assert found == {
        ("xelite", "fp16_qnn_dlc"): {key: pytest.approx((30.0 * n, 0.25, "assumed")) for n, key in enumerate(KEYS, 1)},
        ("qcs6490", "int8_qnn_dlc"): {key: pytest.approx((2.5 * n, 0.25, "assumed")) for n, key in enumerate(KEYS, 1)},
        ("qcs6490", "fp16_qnn_dlc"): {key: pytest.approx((3.5 * n, 0.25, "assumed")) for n, key in enumerate(KEYS, 1)},
    }
    assert list(engine_study._assumed(known, ALL[:1])) == []


def test_how_many_rows_lie_in_their_intervals() -> None:
    """Logarithms of 0.1, 0.2 and 0.3; intervals reach 1.2816 times as far as the error and what is open, together."""
    rows = [left_out("int8_tflite", "c", "f", math.exp(log) - 1, unsure) for log, unsure in ((0.1, 0), (-0.2, 0.12))]
    rows.append(left_out("int8_tflite", "c", "f", math.exp(0.3) - 1, 0.15))
    misses, unsure, unlike = misses_of(rows)
    assert unlike.tolist() == [1, 1, 1]
    assert misses == pytest.approx([0.1, 0.2, 0.3]) and unsure == pytest.approx([0, 0.12, 0.15])
    fitted = numbers_of("int8_tflite", ["c"])
    # 1.2816 * (0.1, 0.1562, 0.1803) = 0.128, 0.2002, 0.231
    assert EngineStudy(fitted, tuple(rows), 0.1).coverage == pytest.approx(2 / 3)
    assert EngineStudy(fitted, tuple(rows), 0.099).coverage == pytest.approx(1 / 3)
    halfway = tuple(row._replace(unlike=0.5) for row in rows)
    assert EngineStudy(fitted, halfway, 0.2).coverage == pytest.approx(2 / 3)
    assert SIGMAS == 1.2816


def made_study(engines: Sequence[EngineName] = ("int8_tflite", "fp16_tflite")) -> Study:
    """Two chips of Hexagon v68, which are as in the middle of both, one more, and one whose profile nobody has."""
    usual = (
        left_out("int8_tflite", "8gen2", "cnn", 0.1),
        left_out("int8_tflite", "8gen2", "unet", -0.2),
        left_out("int8_tflite", "sa8295p", "cnn", 0.3),
    )
    studies = {
        name: EngineStudy(numbers_of(name, ["8gen2"]), usual if name == "int8_tflite" else usual[:1], 0.2)
        for name in engines
    }
    known = {("sa8295p", engines[0]): rates(1.0), ("qcs6490", engines[0]): rates(4.0, "assumed")}
    known |= {(chip, name): rates(8.0) for chip in ("8gen2", "other") for name in engines}
    known |= {("sa8295p", name): rates(5.0) for name in engines[1:]}
    return Study(studies, known)  # type: ignore[arg-type]


def test_the_tables_of_errors() -> None:
    """Of 10, 20 and 30 %: the middle is 20 %, nine tenths are within 28 %, and intervals reach a factor of 1.29."""
    assert as_markdown(made_study()).splitlines() == [
        "| engine | rows | median | p90 | within 15 % | in the 80 % interval |",
        "|---|---|---|---|---|---|",
        "| `int8_tflite` | 3 | 20 % | 28 % | 33 % | 67 % |",
        "| `fp16_tflite` | 1 | 10 % | 10 % | 100 % | 100 % |",
        "",
        "| median error, `int8_tflite` | 8gen2 | sa8295p | all |",
        "|---|---|---|---|",
        "| cnn | 10 % | 30 % | 20 % |",
        "| unet | 20 % |  | 20 % |",
        "| all | 15 % | 30 % | 20 % |",
    ]


def test_what_is_written_into_profiles(tmp_path: Path) -> None:
    """Each number as TOML. The shared ones are the middle of the two chips: 2 is between 1 and 4, a factor of 2 off."""
    for name in ("hexagon", "snapdragon-8-gen-2", "qcs6490", "sa8295p"):
        (tmp_path / f"{name}.toml").write_text(f'name = "{name}"\n{MARK}\nold = 1\n')
    texts = profile_texts(made_study(), tmp_path, 'fit "it"')
    assert {path.name for path in texts} == {f"{path.name}" for path in tmp_path.iterdir()}
    assert all(text.count(MARK) == 1 and text.endswith("}\n") for text in texts.values())
    read = {path.stem: tomllib.loads(text) for path, text in texts.items()}
    assert all(data["name"] == name for name, data in read.items())
    of_gen_2 = read["snapdragon-8-gen-2"]["units"]["dsp"]["engines"]
    assert list(of_gen_2) == ["int8_tflite", "fp16_tflite"]
    vtcm = {"kind": "published", "spread": 0.1, "source": "VTCM of its generation"}
    for engine in of_gen_2.values():
        assert engine["on_chip_mb"] == {"value": ON_CHIP_MB["v73"], **vtcm}
        assert engine["rates"] == {
            key: {"value": 8.0 * n, "kind": "fitted", "spread": 0.5, "source": 'fit "it"'}
            for n, key in enumerate(KEYS, 1)
        }
    assert list(read["qcs6490"]["units"]["dsp"]["engines"]) == ["int8_tflite"]
    assert read["qcs6490"]["units"]["dsp"]["engines"]["int8_tflite"]["rates"]["job_us"]["kind"] == "assumed"
    shared = read["hexagon"]["units"]["dsp"]["engines"]
    assert [engine["element_bytes"] for engine in shared.values()] == [1, 2]
    plain, half = shared.values()
    assert plain["on_chip_mb"] == {"value": ON_CHIP_MB["v68"], **vtcm}
    rows = "cross-validation over networks, {} rows: 87 % of them lie in their intervals"
    assert [engine["error_fraction"] for engine in (plain, half)] == [
        {"value": 0.2, "kind": "fitted", "spread": 0.3, "source": rows.format(count)} for count in (3, 1)
    ]
    source = 'fit "it", mean of the chips of Hexagon v68'
    assert plain["rates"]["arithmetic_tmac_s"] == {"value": 2.0, "kind": "fitted", "spread": 0.85, "source": source}
    assert half["rates"]["job_us"] == {"value": 30.0, "kind": "fitted", "spread": 0.5, "source": source}
    factor = {"value": 3.0, "kind": "fitted", "spread": 0.25, "source": 'fit "it", factors shared by all chips'}
    assert plain["factors"] == half["factors"] == {name: factor for name in NAMES if name not in UNITS_OF_RATES}


def test_priors_by_hand() -> None:
    """The 888's sister is four times slower than the 8 Gen 2, in FP16 a quarter of that; its costs grow."""
    assert rate_prior("int8_tflite", "8gen2", "arithmetic_tmac_s") == Prior(17, 0.5)
    assert rate_prior("fp16_tflite", "qcs6490", "arithmetic_tmac_s").value == pytest.approx(17 / 16)
    assert rate_prior("fp16_qnn_dlc", "qcs6490", "operator_us").value == pytest.approx(1.5 * 4)
    assert rate_prior("fp16_tflite", "8gen3", "job_us").value == pytest.approx(1.5 * 80 * 0.75)
    assert rate_prior("fp16_tflite", "8gen3", "spill_gb_s").value == pytest.approx(30 / 0.75)
    assert rate_prior("int8_tflite", "unheard of", "weight_gb_s").value == 40
    assert factor_prior("int8_tflite", "batch_norm") == Prior(10, 0.7)
    assert factor_prior("fp16_qnn_dlc", "batch_norm") == Prior(2, 0.7)
    assert factor_prior("fp16_tflite", "divide") == factor_prior("int8_tflite", "divide") == FACTORS["divide"]
    assert factor_prior("int8_tflite", "moved") == Prior(1, 1e-6)
    assert all(TERMS[name] == rate for name, rate in zip(UNITS_OF_RATES[:2], RATES[:2], strict=True))


def test_a_picture_of_the_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point for each row, the line on which both agree, and those 15 % beside it, on logarithmic axes."""
    figure = pytest.importorskip("matplotlib.figure")
    drawn: list[Any] = []

    class Kept(figure.Figure):  # type: ignore[misc,name-defined]
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            drawn.append(self)

    monkeypatch.setattr(figure, "Figure", Kept)
    plot_errors(made_study(), tmp_path / "errors.svg")
    assert (tmp_path / "errors.svg").read_text().startswith("<?xml")
    (axes,) = drawn[0].axes
    lines = [(line.get_xdata(), line.get_ydata()) for line in axes.lines]
    assert [[list(side) for side in line] for line in lines[:2]] == [
        [[2.0] * 3, pytest.approx([2.2, 1.6, 2.6])],
        [[2.0], pytest.approx([2.2])],
    ]
    assert [line[1] / line[0] for line in lines[2:]] == [pytest.approx([f, f]) for f in (1, 1.15, 1 / 1.15)]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    with pytest.raises(BadInputError, match=r"found the ending '\.gif', expected one of"):
        plot_errors(made_study(), tmp_path / "errors.gif")


def test_the_command_writes_what_is_asked_for(
    command: Callable[..., tuple[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Path] = []
    monkeypatch.setattr(engine_study, "study_engines", lambda folder: asked.append(folder) or made_study())
    page, profiles = tmp_path / "page.md", tmp_path / "profiles"
    page.write_text(f"# Page\n{BEGIN}\n{END}\n")
    profiles.mkdir()
    for name in ("hexagon", "snapdragon-8-gen-2", "qcs6490", "sa8295p"):
        (profiles / f"{name}.toml").write_text(f'name = "{name}"\n')
    out, _ = command("profiles", "fit-chips", "data", "--write", profiles, "--table", page)
    assert out.strip() == as_markdown(made_study())
    assert page.read_text() == f"# Page\n{BEGIN}\n{as_markdown(made_study())}\n{END}\n"
    assert asked == [Path("data")]
    written = profile_texts(made_study(), profiles, "profiles fit-chips data")
    assert {path: path.read_text() for path in profiles.iterdir()} == written
