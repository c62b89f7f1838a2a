"""Measurements of other tools: rows typed off public files, and broken variants of each.

What is read is compared with what the source states, in its own unit of measure. Each file has its source beside it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import combinations, pairwise
from pathlib import Path
from random import Random
from time import perf_counter

import pytest

from support.mutations import mutated
from trilane.errors import BadInputError
from trilane.pipeline.measurements.measurement import Measurements, falling
from trilane.pipeline.measurements.read_file import OWN_COLUMNS, chosen, read_measurements

#: usefulsensors/qc_npu_benchmark, npu_quant_profile.csv; the second run is of tezheng/winml-cli, optrace_resnet50.csv.
QNN = """Msg Timestamp,Message,Time,Unit of Measurement,Timing Source,Event Level,Event Identifier
0,BACKEND,43624,US,BACKEND,ROOT,RPC (finalize) time
0,FINALIZE,2049932,US,BACKEND,ROOT,QNN (finalize) time
0,BACKEND,4,COUNT,BACKEND,ROOT,Number of HVX threads used
0,BACKEND,88338,US,BACKEND,ROOT,RPC (execute) time
0,BACKEND,87857,US,BACKEND,ROOT,QNN accelerator (execute) time
0,BACKEND,1970,US,BACKEND,ROOT,Time for HVX + HMX power on and acquire
0,BACKEND,51117377,CYCLES,BACKEND,ROOT,Accelerator (execute) time (cycles)
0,NODE,10958875,CYCLES,BACKEND,SUB-EVENT,matmul_node:OpId_18 (cycles)
0,NODE,32129948,CYCLES,BACKEND,SUB-EVENT,matmul_output_tensor_DequantizeLinear:OpId_22 (cycles)
0,BACKEND,26024,US,BACKEND,ROOT,Accelerator (execute) time
0,BACKEND,25815,US,BACKEND,ROOT,Accelerator (execute excluding wait) time
0,EXECUTE,99091,US,BACKEND,ROOT,QNN (execute) time
0,BACKEND,7784,US,BACKEND,ROOT,RPC (execute) time
0,BACKEND,1359,US,BACKEND,ROOT,Accelerator (execute) time
0,UNKNOWN,UNKNOWN,OBJECT,BACKEND,ROOT,Unknown event type
0,EXECUTE,9308,US,BACKEND,ROOT,QNN (execute) time
"""
#: tezheng/winml-cli, tests/unit/session/monitor/qnn/fixtures/qhas_resnet50.json.
QHAS = """{"header": {"artifact_type": "QHAS"}, "data": {"htp_overall_summary": {"data": [{
"percent_utilization": 99.59153909635607, "time_us": 1343, "graph_execute_us": 1132,
"inf_per_s": 744.6016381236038, "timeline_cycles": 1582526, "total_dram_read": 26634240, "total_dram": 26638336}]},
"qnn_op_instances_nodes": {"data": [
{"qnn_op": "/resnet/embedder/embedder/convolution/Conv_token_1_2", "qnn_op_type": "Conv2d", "cycles": 671293},
{"qnn_op": "Transpose_token_328_2", "qnn_op_type": "Transpose", "cycles": 277418}]}}}
"""
#: The reference of MQL5, "ONNX profiling", https://www.mql5.com/en/docs/onnx/onnx_structures, shortened arguments.
ORT = """[
{"cat" : "Session","pid" :34368,"tid" :39520,"dur" :698,"ts" :11,"ph" : "X","name" :"model_loading_array","args" : {}},
{"cat" : "Node","pid" :1,"tid" :2,"dur" :66055,"ts" :16800,"ph" : "X","name" :"Convolution28_kernel_time",\
"args" : {"provider" : "CUDAExecutionProvider","op_name" : "Conv"}},
{"cat" : "Node","pid" :1,"tid" :2,"dur" :775,"ts" :82867,"ph" : "X","name" :"ReLU32_kernel_time","args" : {}},
{"cat" : "Session","pid" :1,"tid" :2,"dur" :109165,"ts" :16794,"ph" : "X","name" :"SequentialExecutor::Execute"},
{"cat" : "Session","pid" :1,"tid" :2,"dur" :109600,"ts" :16433,"ph" : "X","name" :"model_run","args" : {}},
{"cat" : "Node","pid" :1,"tid" :2,"dur" :87,"ts" :126313,"ph" : "X","name" :"Convolution28_kernel_time","args" : {}}
]
"""
#: lp6m/yolov5s_android, benchmark/benchmark.md; the first line is of the other logs of the tool.
TFLITE = """Running benchmark for at least 1 iterations and at least 0.5 seconds
count=2 first=247583 curr=196689 min=196689 max=247583 avg=222136 std=25447
--graph=/data/local/tmp/yolov5s_tflite_fp32.tflite
count=50 first=207897 curr=225553 min=206675 max=231957 avg=220000 std=6795
Inference timings in us: Init: 1430, First inference: 247583, Warmup (avg): 222136, Inference (avg): 220000
--graph=/data/local/tmp/yolov5s_tflite_int8.tflite
count=50 first=157506 curr=159864 min=157298 max=165731 avg=159413 std=1311 p5=157400 median=159000 p95=161000
Inference timings in us: Init: 1829, First inference: 232333, Warmup (avg): 184951, Inference (avg): 159413
Operator-wise Profiling Info for Regular Benchmark Runs:
============================== Run Order ==============================
\t [node type]\t [start]\t [first]\t [avg ms]\t [%]\t [cdf%]\t [mem KB]\t[times called]\t[Name]
\t TfLiteNnapiDelegate\t 8.366\t 86.415\t 83.750\t 50.878%\t 55.945%\t 0.000\t 1\t[model/tf.math.multiply_23/Mul]:270
"""
#: mlcommons/mobile_results_v5.0, closed/Qualcomm_Innovation_Center/results/SD7SG3/image_classification_v2-performance.
LOADGEN = """MLPerf Results Summary
SUT name : snpe
Scenario : SingleStream
Mode     : PerformanceOnly
90th percentile latency (ns) : 5790000
Result is : VALID
 * Processed at least 64 queries (10461).
QPS w/o loadgen overhead        : 174.38
Min latency (ns)                : 5508854
Max latency (ns)                : 24865521
Mean latency (ns)               : 5734487
50.00 percentile latency (ns)   : 5718542
90.00 percentile latency (ns)   : 5790000
95.00 percentile latency (ns)   : 5845678
99.90 percentile latency (ns)   : 6247240
"""
#: The same, results/SD7SG3/result.json.
APP = """{"results": [
{"benchmark_id": "image_classification_v2", "loadgen_scenario": "SingleStream",
"backend_settings": {"accelerator_desc": "HTP"}, "performance_run": {"throughput": {"value": 172.71157167530225},
"loadgen": {"query_count": 10461, "latency_mean": 0.005734487, "latency90": 0.00579, "is_result_valid": true}}},
{"benchmark_id": "image_classification_offline_v2", "loadgen_scenario": "Offline", "performance_run":
{"throughput": {"value": 193.95539053091514}, "loadgen": {"query_count": 1, "latency_mean": 127.451987451}}}]}
"""
#: ismetdagli/HaX-CoNN, build2/googlenet_transition_plans/profiles/googlenet_gpu_transition_at_10.profile.
TENSORRT = """[
  { "count" : 11596 }
, { "name" : "conv1/7x7_s2", "timeMs" : 964.097, "averageMs" : 0.0831405, "percentage" : 2.85106 }
, { "name" : "pool1/3x3_s2", "timeMs" : 303.378, "averageMs" : 0.0261623, "percentage" : 0.897159 }
, { "name" : "prob", "timeMs" : 102.37, "averageMs" : 0.00882802, "percentage" : 0.302731 }
]
"""
#: qai-hub, its client's own test of `download_profile()`.
AI_HUB = """{"execution_summary": {"estimated_inference_time": 3652, "first_load_time": 1374293,
"all_inference_times": [10003, 4205]},
"execution_detail": [{"compute_unit": "CPU", "execution_time": 23, "name": "model/truediv", "type": "MUL"},
{"compute_unit": "NPU", "execution_cycles": 180315, "execution_time": 127, "name": "transpose", "type": "TRANSPOSE"}]}
"""
#: ismetdagli/HaX-CoNN, output/dla_compute_times.json, rounded: every second rest time is one that was not measured.
CUTS = """{"googlenet_gpu_transition_at_124": {"total_time": 0.409}, "googlenet_gpu_transition_at_110": {"total_time":
0.0143}, "googlenet_gpu_transition_at_95": {"total_time": 0.944}, "googlenet_gpu_transition_at_81": {"total_time":
0.024}, "googlenet_gpu_transition_at_67": {"total_time": 1.385}, "googlenet_gpu_transition_at_53": {"total_time":
0.025}, "googlenet_gpu_transition_at_38": {"total_time": 1.923}, "googlenet_gpu_transition_at_24": {"total_time":
2.255}, "googlenet_gpu_transition_at_10": {"total_time": 2.434}, "googlenet_dla_transition_at_-1": {"total_time": 0}}
"""
#: software-mansion/react-native-executorch, apps/benchmarks/baselines/et-1.3.1-full-android-SM-S948B.json.
EXECUTORCH = """{"schemaVersion": 1, "cases": [{"id": "classification/efficientnet-v2-s-xnnpack-int8", "status": "ok",
"pipeline": {"count": 20, "min": 52.147, "max": 78.223, "mean": 62.505, "median": 59.921, "p90": 74.323,
"stdev": 7.971},
"native": {"methods": [{"method": "forward", "status": "ok", "stats": {"count": 20, "min": 17.273, "max": 20.217,
"mean": 18.563, "median": 18.523, "p90": 19.169, "stdev": 0.601}}]}}]}
"""
FILES = {
    "qnn": QNN,
    "qhas": QHAS,
    "ort": ORT,
    "tflite": TFLITE,
    "loadgen": LOADGEN,
    "app": APP,
    "tensorrt": TENSORRT,
    "ai_hub": AI_HUB,
    "cuts": CUTS,
    "executorch": EXECUTORCH,
}
EFFICIENTNET = "classification/efficientnet-v2-s-xnnpack-int8"
FORWARD = f"cases[0].native.forward: {EFFICIENTNET}"
#: format -> (name, kind) -> count and mean in ms, of every time that the rows state.
EXPECTED: dict[str, dict[tuple[str, str], tuple[int | None, float]]] = {
    "qnn": {
        ("QNN (execute) time", "run"): (2, (99.091 + 9.308) / 2),
        ("RPC (execute) time", "run"): (2, (88.338 + 7.784) / 2),
        ("QNN accelerator (execute) time", "run"): (1, 87.857),
        ("Accelerator (execute) time", "run"): (2, (26.024 + 1.359) / 2),
        ("Accelerator (execute excluding wait) time", "run"): (1, 25.815),
    },
    "qhas": {("time_us", "run"): (None, 1.343), ("graph_execute_us", "run"): (None, 1.132)},
    "ort": {
        ("model_run", "run"): (1, 109.6),
        ("SequentialExecutor::Execute", "run"): (1, 109.165),
        ("Convolution28", "layer"): (2, (66.055 + 0.087) / 2),
        ("ReLU32", "layer"): (1, 0.775),
    },
    "tflite": {
        ("yolov5s_tflite_fp32.tflite", "run"): (50, 220.0),
        ("yolov5s_tflite_int8.tflite", "run"): (50, 159.413),
        ("TfLiteNnapiDelegate [model/tf.math.multiply_23/Mul]:270", "layer"): (None, 83.75),
    },
    "loadgen": {("snpe", "run"): (10461, 5.734487)},
    "app": {
        ("image_classification_v2", "run"): (10461, 5.734487),
        ("image_classification_offline_v2", "wall"): (1, 127451.987451),
    },
    "tensorrt": {
        ("all layers", "run"): (11596, 0.0831405 + 0.0261623 + 0.00882802),
        ("conv1/7x7_s2", "layer"): (11596, 0.0831405),
        ("pool1/3x3_s2", "layer"): (11596, 0.0261623),
        ("prob", "layer"): (11596, 0.00882802),
    },
    "ai_hub": {
        ("all_inference_times", "run"): (2, (10.003 + 4.205) / 2),
        ("estimated_inference_time", "run"): (None, 3.652),
        ("model/truediv", "layer"): (None, 0.023),
        ("transpose", "layer"): (None, 0.127),
    },
    "cuts": {
        (f"googlenet_gpu_transition_at_{at}", "run"): (None, ms)
        for at, ms in ((124, 0.409), (95, 0.944), (67, 1.385), (38, 1.923), (24, 2.255), (10, 2.434))
    },
    "executorch": {
        (f"{EFFICIENTNET}/pipeline", "wall"): (20, 62.505),
        (f"{EFFICIENTNET}/forward", "run"): (20, 18.563),
    },
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("written", [str, lambda text: "\ufeff" + text.replace("\n", "\r\n")], ids=["plain", "windows"])
def test_what_is_read_is_what_the_source_states(
    name: str, written: Callable[[str], str], read: Callable[[str], Measurements]
) -> None:
    found = read(written(FILES[name]))
    timed = {(each.name, each.kind): (each.count, each.mean_ms) for each in found.measurements if each.unit != "cycles"}
    assert timed.keys() == EXPECTED[name].keys()
    for key, (count, mean) in EXPECTED[name].items():
        assert timed[key] == (count, pytest.approx(mean, rel=1e-12)), key


def test_samples_percentiles_and_what_is_beside_them(read: Callable[[str], Measurements]) -> None:
    by_name = {
        each.name: each for name in ("qnn", "tflite", "loadgen", "ai_hub") for each in read(FILES[name]).measurements
    }
    assert by_name["RPC (execute) time"].samples_ms == (88.338, 7.784)
    assert by_name["all_inference_times"].samples_ms == (10.003, 4.205)
    int8 = by_name["yolov5s_tflite_int8.tflite"]
    assert (int8.sd_ms, int8.min_ms, int8.p50_ms, int8.p95_ms, int8.max_ms) == (1.311, 157.298, 159.0, 161.0, 165.731)
    assert (by_name["snpe"].p50_ms, by_name["snpe"].p95_ms) == (5.718542, 5.845678)
    assert by_name["snpe"].more["p99.9_ms"] == 6.24724
    assert by_name["transpose"].hardware == "NPU"


def test_cycles_are_shares_alone(read: Callable[[str], Measurements]) -> None:
    nodes = [each for each in read(QNN).measurements if each.kind == "layer"]
    assert [each.share for each in nodes] == pytest.approx([10958875 / 43088823, 32129948 / 43088823])
    assert all(each.mean_ms is None and not each.service and not each.samples_ms for each in nodes)
    with pytest.raises(BadInputError, match="cycles are shares"):
        chosen(read(QNN), "matmul_node:OpId_18 (cycles)", "x")


def test_what_is_no_run_is_counted(read: Callable[[str], Measurements]) -> None:
    assert read(QNN).skipped == {
        "no time of a run, such as preparing the graph or acquiring memory": 3,
        "a count, not a time": 2,
        "cycles of a run, whose clock is not known": 1,
    }
    cycles = "0,BACKEND,51117377,CYCLES,BACKEND,ROOT,Accelerator (execute) time (cycles)\n"
    assert read(QNN + cycles).skipped["cycles of a run, whose clock is not known"] == 2
    assert read(TFLITE.replace("--graph=/data/local/tmp/yolov5s_tflite_fp32.tflite\n", "")).skipped == {"warm-up": 1}


def test_only_single_stream_is_a_service_time(read: Callable[[str], Measurements]) -> None:
    for text in (APP, LOADGEN.replace("SingleStream", "Server")):
        found = read(text)
        (wall,) = [each for each in found.measurements if each.kind == "wall"]
        assert not wall.service
        assert not found.refused
        with pytest.raises(BadInputError, match="queueing is no service time"):
            chosen(found, wall.name, "x")
    assert chosen(read(LOADGEN), "", "x").mean_ms == 5.734487


def test_offline_is_a_throughput(read: Callable[[str], Measurements]) -> None:
    offline = LOADGEN.replace("SingleStream", "Offline").replace("QPS w/o", "Samples per second: 1992.95\nQPS w/o")
    found = read(offline)
    (one,) = found.measurements
    assert found.says == "one query with all samples (Offline): a throughput, and no latency of a run"
    assert (one.what, one.hint) == ("all samples at once (Offline)", "1992.95 samples a second")
    assert one.more["samples_per_second"] == 1992.95


def test_rest_times_that_rise_again(read: Callable[[str], Measurements]) -> None:
    """Behind cut 38: of 1.923, 0.025, 1.385, 0.024, 0.944, 0.0143, 0.409 the four that fall stay."""
    refused = {each.row: each.reason for each in read(CUTS).refused}
    assert list(refused) == [
        "googlenet_dla_transition_at_-1",
        *(f"googlenet_gpu_transition_at_{n}" for n in (53, 81, 110)),
    ]
    assert refused["googlenet_gpu_transition_at_81"] == (
        "rest times rise again: 0.024 ms behind cut 81, 0.944 ms behind the later cut 95"
    )


@pytest.mark.parametrize("seed", range(40))
def test_a_longest_series_of_falling_times_is_kept(seed: int) -> None:
    """Against all subsequences, by length and then by sum; equal times and times within the slack may follow."""
    draw = Random(seed)
    values = [draw.choice([1.0, 2.0, 2.1, 3.0, draw.uniform(1, 3)]) for _ in range(draw.randint(0, 10))]
    slack = draw.choice([0.0, 0.06])
    kept = falling(values, slack)
    fit = [
        series
        for size in range(len(values) + 1)
        for series in combinations(range(len(values)), size)
        if all(values[after] <= values[before] * (1 + slack) for before, after in pairwise(series))
    ]
    assert tuple(kept) in fit
    best = max((len(series), sum(values[place] for place in series)) for series in fit)
    assert (len(kept), sum(values[place] for place in kept)) == pytest.approx(best)


def test_a_table_of_many_cuts_is_read_at_once(read: Callable[[str], Measurements]) -> None:
    """Every second time is too short: half of 4000 are refused."""
    times = {f"net_at_{cut}": {"total_time": 1e5 - cut if cut % 2 else 1.0 + cut / 1e5} for cut in range(4000)}
    begun = perf_counter()
    found = read(json.dumps(times))
    assert perf_counter() - begun < 20
    assert (len(found.measurements), found.refused_count) == (2000, 2000)


def test_a_refused_cut_has_the_name_that_is_in_the_file(read: Callable[[str], Measurements]) -> None:
    """The reason names the last time before it that stays."""
    rest = {"01": 7, "02": 6, "03": 5, "04": 9, "05": 8, "06": 5}
    found = read(json.dumps({f"net_at_{cut}": {"total_time": ms} for cut, ms in rest.items()}))
    assert [each.name for each in found.measurements] == [f"net_at_0{cut}" for cut in (1, 2, 3, 6)]
    assert [(each.row, each.reason) for each in found.refused] == [
        ("net_at_04", "rest times rise again: 5 ms behind cut 3, 9 ms behind the later cut 4"),
        ("net_at_05", "rest times rise again: 5 ms behind cut 3, 8 ms behind the later cut 5"),
    ]


Change = tuple[str, str, str, str]
#: format -> what is replaced, by what, the refused row, a word of the reason.
BROKEN: dict[str, list[Change]] = {
    "qnn": [
        ("88338,US", "-88338,US", "line 5: RPC (execute) time", "negative"),
        ("88338,US", "nan,US", "line 5: RPC (execute) time", "finite"),
        ("88338,US", ",US", "line 5: RPC (execute) time", "a number was expected"),
        ("88338,US", "88338,CYCLES", "line 5: RPC (execute) time", "unit is CYCLES"),
        ("88338,US", "88338,HOURS", "line 5: RPC (execute) time", "unknown unit"),
        ("88338,US", "88,US", "line 5: RPC (execute) time", "shorter than 'QNN accelerator (execute) time' within it"),
        (
            "26024,US",
            "260240,US",
            "line 11: Accelerator (execute) time",
            "longer than 'QNN accelerator (execute) time'",
        ),
        ("7784,US", "0,US", "line 14: RPC (execute) time", "a run takes time"),
        ("10958875,CYCLES", "-1,CYCLES", "line 9: matmul_node:OpId_18 (cycles)", "negative"),
    ],
    "qhas": [
        ('"time_us": 1343', '"time_us": 1.343', "htp_overall_summary.data[0]: time_us", "a unit is wrong"),
        ('"time_us": 1343,', "", "htp_overall_summary.data[0]: time_us", "nothing"),
        ('_us": 1132', '_us": 11320', "htp_overall_summary.data[0]: graph_execute_us", "longer than"),
        ('"cycles": 671293', '"cycles": -5', "qnn_op_instances_nodes.data[0]: /resnet/embedder/embedder/", "negative"),
        ('"cycles": 277418', '"cycles": 1e999', "qnn_op_instances_nodes.data[1]: Transpose_token_328_2", "finite"),
    ],
    "ort": [
        ('"dur" :109600,', "", "event 4: model_run", "nothing"),
        ('"dur" :109600', '"dur" :0', "event 4: model_run", "a run takes time"),
        ('"dur" :775', '"dur" :-775', "event 2: ReLU32_kernel_time", "negative"),
        ('"model_run","args" : {}},', '"model_ru', "line 6", "cut off"),
        ('"args" : {}}\n]\n', '"args" : {}},\n{"cat" : "No', "line 8", "cut off"),
    ],
    "tflite": [
        ("avg=220000", "avg=nan", "line 4: yolov5s_tflite_fp32.tflite", "finite"),
        ("avg=220000", "avg=320000", "line 4: yolov5s_tflite_fp32.tflite", "says Inference (avg): 220000"),
        ("min=206675", "min=306675", "line 4: yolov5s_tflite_fp32.tflite", "above the largest"),
        ("count=50 first=207897", "count=0 first=207897", "line 4: yolov5s_tflite_fp32.tflite", "whole number"),
        ("count=50 first=207897", "count=1.5 first=207897", "line 4: yolov5s_tflite_fp32.tflite", "whole number"),
        ("std=6795", "std=-6795", "line 4: yolov5s_tflite_fp32.tflite", "negative"),
        ("std=6795", "std=67950", "line 4: yolov5s_tflite_fp32.tflite", "larger than all of the range"),
        ("median=159000", "median=162000", "line 7: yolov5s_tflite_int8.tflite", "the median (162 ms) is above p95"),
        ("first=157506", "first=15750", "line 7: yolov5s_tflite_int8.tflite", "below the least"),
        ("83.750", "-83.750", "line 12: TfLiteNnapiDelegate [model/tf.math.multiply_23/Mul]:270", "negative"),
    ],
    "loadgen": [
        (": 5734487", ": -5", "line 11: Mean latency (ns)", "negative"),
        (": 5734487", ": nan", "line 11: Mean latency (ns)", "finite"),
        (": 5734487", ": 5.734487", "line 11: Mean latency (ns)", "below the least"),
        (": 5734487", ": x", "line 11: Mean latency (ns)", "a number was expected"),
        (": 5508854", ": 6508854", "line 11: Mean latency (ns)", "above the median"),
        (": 24865521", ": 4865521", "line 11: Mean latency (ns)", "above the largest"),
        (": 5718542", ": 5799999", "line 11: Mean latency (ns)", "the percentile 50 (5.8 ms) is above"),
        (": 174.38", ": 17.438", "line 11: Mean latency (ns)", "a unit is wrong"),
        ("PerformanceOnly", "AccuracyOnly", "line 4: Mode", "accuracy"),
        (": SingleStream", ": Stream", "line 3", "none of"),
    ],
    "app": [
        ("0.005734487", "5.734487", "results[0]: image_classification_v2", "a unit is wrong"),
        ("0.005734487", "0", "results[0]: image_classification_v2", "a run takes time"),
        ("10461", "-1", "results[0]: image_classification_v2", "whole number"),
        ("10461", "1.5", "results[0]: image_classification_v2", "whole number"),
        ('"SingleStream"', '"Stream"', "results[0]: image_classification_v2", "none of"),
        ("127.451987451", "1e9", "results[1]: image_classification_offline_v2", "over an hour"),
    ],
    "tensorrt": [
        ('"averageMs" : 0.0831405', '"averageMs" : 0.1831405', "row 1: conv1/7x7_s2", "timeMs / count is 0.083140"),
        ('"averageMs" : 0.0831405, ', "", "row 1: conv1/7x7_s2", "nothing"),
        ('"timeMs" : 303.378', '"timeMs" : -1', "row 2: pool1/3x3_s2", "negative"),
        ('"count" : 11596', '"count" : -1', "row 0", "negative"),
        ('"count" : 11596', '"count" : 1.5', "row 0", "whole number"),
    ],
    "ai_hub": [
        ("10003", "0", "execution_summary.all_inference_times[0]", "a run takes time"),
        ("3652", "-3652", "execution_summary.estimated_inference_time", "negative"),
        ('"execution_time": 23', '"execution_time": -23', "execution_detail[0]: model/truediv", "negative"),
        ('{"compute_unit": "CPU"', '7, {"compute_unit": "CPU"', "execution_detail[0]", "no table"),
    ],
    "cuts": [
        ("0.409", "1.0", "googlenet_gpu_transition_at_124", "rise again"),
        ("2.255", "5", "googlenet_gpu_transition_at_10", "2.434 ms behind cut 10, 5 ms behind the later cut 24"),
        ('"total_time": 0.409', '"time": 1', "googlenet_gpu_transition_at_124", "nothing"),
    ],
    "executorch": [
        ("18.563", "185.63", FORWARD, "above the largest"),
        ("18.563", "1.8563", FORWARD, "below the least"),
        ('"mean": 18.563, ', "", FORWARD, "no mean"),
        ('"stdev": 0.601', '"stdev": 60.1', FORWARD, "larger than all of the range"),
        ('"median": 18.523', '"median": 20.5', FORWARD, "above the largest"),
        ('"count": 20, "min": 17.273', '"count": 0, "min": 17.273', FORWARD, "whole"),
        ('"count": 20, "min": 17.273', '"count": true, "min": 17.273', FORWARD, "whole"),
        ("62.505", "0", f"cases[0].pipeline: {EFFICIENTNET}", "a run takes time"),
    ],
}
#: format in JSON -> a time of it, and its row.
A_TIME = {
    "qhas": ("1343,", "htp_overall_summary.data[0]: time_us"),
    "ort": ("109600,", "event 4: model_run"),
    "app": ("0.005734487,", "results[0]: image_classification_v2"),
    "tensorrt": ("0.0831405,", "row 1: conv1/7x7_s2"),
    "ai_hub": ("10003,", "execution_summary.all_inference_times[0]"),
    "cuts": ("0.409}", "googlenet_gpu_transition_at_124"),
    "executorch": ("18.563,", FORWARD),
}
#: What stands in its place -> a word of the reason.
NO_TIMES = {
    "-1": "negative",
    "NaN": "finite",
    **dict.fromkeys(('"1"', "true", "[]"), "a number was expected"),
    "null": "nothing",
}


def changes(name: str) -> list[Change]:
    if name not in A_TIME:
        return BROKEN[name]
    time, row = A_TIME[name]
    return BROKEN[name] + [(time, bad + time[-1], row, reason) for bad, reason in NO_TIMES.items()]


@pytest.mark.parametrize(("name", "change"), [(name, change) for name in BROKEN for change in changes(name)], ids=str)
def test_a_broken_row_is_named_and_the_others_stay(
    name: str, change: Change, read: Callable[[str], Measurements]
) -> None:
    old, new, row, reason = change
    assert FILES[name].count(old) == 1, "the change is of one place"
    before = {(each.row, each.reason) for each in read(FILES[name]).refused}
    try:
        found = read(FILES[name].replace(old, new))
    except BadInputError as error:  # nothing else is left in the file
        assert row in str(error), error
        assert reason in str(error), error
        return
    news = [each for each in found.refused if each not in before]
    assert [each.row[: len(row)] for each in news] == [row], news
    assert reason in news[0].reason
    sound = {key: value for key, value in EXPECTED[name].items() if key[0] != "all layers"}
    timed = {(each.name, each.kind) for each in found.measurements}
    assert len(sound.keys() - timed) <= 2, "the rows beside it stay"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "an empty file"),
        ("hello\nworld\n", "text that begins with 'hello'"),
        ("[" * 200_000, "too deep|no JSON"),
        ('{"a": ' * 100_000, "too deep|no JSON"),
        ("{}", "no known tool"),
        ("[1, 2, 3]", "no known tool"),
        ('{"results": [{"loadgen_scenario": "SingleStream"', "no JSON"),
        ("7", "text that begins with '7'"),
        (f'{{"net_at_{"9" * 5000}": {{"total_time": 1}}}}', "no known tool"),
        ('{"data": [], "htp_overall_summary": {"data": []}}', "no usable time in the QHAS summary"),
        ('{"execution_summary": {"estimated_inference_time": ' + "9" * 5000 + "}}", "finite"),
        (
            "Msg Timestamp,Message,Time,Unit of Measurement,Timing Source,Event Level,Event Identifier\n",
            "no usable time in the QNN profile",
        ),
        ("Msg Timestamp,Message,Time\n0,BACKEND,5\n", "without the column 'Unit of Measurement'"),
        ("name\0", "NUL byte"),
    ],
    ids=range(14),
)
def test_what_no_tool_wrote_is_refused(text: str, reason: str, read: Callable[[str], Measurements]) -> None:
    with pytest.raises(BadInputError, match=reason):
        read(text)


def test_commas_in_an_identifier_and_files_joined(read: Callable[[str], Measurements]) -> None:
    """The tool does not quote; a header may come again; a column may follow."""
    header, *rows = QNN.splitlines()
    joined = "\n".join([header, "0,NODE,7,CYCLES,BACKEND,SUB-EVENT,a,b:OpId_1 (cycles)", header, *rows[-2:], ""])
    found = read(joined)
    assert [each.name for each in found.measurements] == ["QNN (execute) time", "a,b:OpId_1 (cycles)"]
    longer = "\n".join([f"{header},ONNX Source Ops", f"{rows[-1]},x", ""])
    assert [each.mean_ms for each in read(longer).measurements] == [9.308]
    cut = "\n".join([header, rows[-1], "0,BACKEND,88338,US,BACK"])
    assert [each.row for each in read(cut).refused] == ["line 3: BACK"]


def test_a_log_that_ends_after_the_warm_up_has_no_runs(read: Callable[[str], Measurements]) -> None:
    with pytest.raises(BadInputError, match="a warm-up: the log ends before the runs do"):
        read("\n".join(TFLITE.splitlines()[:2]))


def test_the_block_of_newer_versions(read: Callable[[str], Measurements]) -> None:
    """The layout of benchmark_litert_model.h (google-ai-edge/LiteRT)."""
    text = "INFO: [x.h:86] Warmup (avg):         0.47 ms (1055 runs)\n"
    text += "INFO: [x.h:88] Inference (avg):      0.46 ms (2112 runs)\n"
    text += "INFO: [x.h:92] Inference (min):      0.44 ms\nINFO: [x.h:94] Inference (max):      0.98 ms\n"
    (one,) = read(text).measurements
    assert (one.count, one.mean_ms, one.min_ms, one.max_ms) == (2112, 0.46, 0.44, 0.98)


def test_a_slow_first_run_is_pointed_out(read: Callable[[str], Measurements]) -> None:
    times = [30_000, 4000, 4100, 3900]
    (one,) = read(json.dumps({"execution_summary": {"all_inference_times": times}})).measurements
    assert one.hint == "the first run took 7.5 times the median: a warm-up?"
    assert one.samples_ms == (30.0, 4.0, 4.1, 3.9)


@pytest.mark.parametrize("name", FILES)
def test_changed_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    """What is read can be printed as JSON, which has no NaN; what is refused names the file."""
    suffix = {"qnn": ".csv", "tflite": ".txt", "loadgen": ".txt"}.get(name, ".json")
    path = tmp_path / f"file{suffix}"
    for number in range(60):
        path.write_bytes(mutated(FILES[name].encode(), suffix, Random(f"{name} {number}")))
        try:
            found = read_measurements(path)
        except BadInputError as error:
            assert str(path) in str(error)
            continue
        json.dumps([each.document() for each in found.measurements], allow_nan=False)
        assert all(each.mean_ms is None or each.mean_ms >= 0 for each in found.measurements)


def runs(found: Measurements) -> dict[str, tuple[float, ...]]:
    return {each.name: each.samples_ms for each in found.measurements if each.kind == "run"}


#: Two executions of two graphs, in the layout of qnn-profile-viewer.
GRAPHS = f"""{QNN.splitlines()[0]}
0,EXECUTE,5000,US,NETRUN,ROOT,Graph 0: small
0,EXECUTE,4800,US,BACKEND,ROOT,NULL
0,EXECUTE,50000,US,NETRUN,ROOT,Graph 1: big
0,EXECUTE,48000,US,BACKEND,ROOT,NULL
"""


def test_executions_of_several_graphs_are_several_runs(read: Callable[[str], Measurements]) -> None:
    found = runs(read(GRAPHS))
    assert {name: ms for name, ms in found.items() if name.startswith("NetRun")} == {
        "NetRun (execute) time of Graph 0: small": (5.0,),
        "NetRun (execute) time of Graph 1: big": (50.0,),
    }
    assert runs(read(GRAPHS.replace("1: big", "0: small")))["NetRun (execute) time"] == (5.0, 50.0)


def test_an_open_quote_takes_no_other_row_with_it(read: Callable[[str], Measurements]) -> None:
    whole, quoted = runs(read(QNN)), runs(read(QNN.replace("RPC (finalize) time", '"RPC (finalize) time')))
    assert quoted == whole and len(whole["QNN (execute) time"]) == 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [(lambda row: row + ",5\n", "a comma in a number"), (lambda row: row[:-1], "ends within the row")],
)
def test_a_row_of_the_own_csv_that_is_not_whole_is_refused(
    change: Callable[[str], str], reason: str, read: Callable[[str], Measurements]
) -> None:
    cells = {"name": "a", "kind": "run", "unit": "us", "ms": "15"}
    row = ",".join(cells.get(name, "0") for name in OWN_COLUMNS)
    found = read(",".join(OWN_COLUMNS) + f"\n{row}\n" + change(row))
    assert runs(found) == {"a": (15.0,)}
    assert [reason in each.reason for each in found.refused] == [True]


def test_two_logs_of_figures_alone_are_two_runs_with_a_warm_up_each(read: Callable[[str], Measurements]) -> None:
    log = "count=2 first=9 curr=9 min=9 max=9 avg=9 std=0\ncount=50 first=5 curr=5 min=5 max=5 avg={0} std=0\n"
    found = read(log.format(5) + log.format(5))
    assert [each.mean_ms for each in found.measurements] == [0.005, 0.005]
    assert found.skipped["warm-up"] == 2


def test_each_figure_of_litert_has_its_own_unit_and_one_without_is_in_that_of_the_mean(
    read: Callable[[str], Measurements],
) -> None:
    lines = {"avg": "465 us (2112 runs)", "min": "0.44 ms", "std": "18"}
    text = "--graph=net.tflite\n" + "".join(
        f"INFO: [x:1] Inference ({name}):  {each}\n" for name, each in lines.items()
    )
    (one,) = read(text).measurements
    assert (one.mean_ms, one.min_ms, one.sd_ms) == pytest.approx((0.465, 0.44, 0.018))
