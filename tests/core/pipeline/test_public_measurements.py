"""More versions of each tool: rows typed off public files, each with its source, and what the source states of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest

from trilane.errors import BadInputError
from trilane.pipeline.measurements.measurement import Measurements
from trilane.pipeline.measurements.read_file import chosen

HEADER = "Msg Timestamp,Message,Time,Unit of Measurement,Timing Source,Event Level,Event Identifier\n"


class Public(NamedTuple):
    """`timed`: count and mean in ms of every time, by name and kind. `refused`: the rows that are refused."""

    text: str
    timed: dict[tuple[str, str], tuple[int | None, float]]
    refused: tuple[str, ...] = ()


PUBLIC: dict[str, Public] = {
    # usefulsensors/qc_npu_benchmark, npu_quant_io_profile.csv
    "qnn, input and output quantised": Public(
        HEADER
        + """0,BACKEND,26825,US,BACKEND,ROOT,RPC (finalize) time
0,BACKEND,64116,US,BACKEND,ROOT,RPC (execute) time
0,BACKEND,63551,US,BACKEND,ROOT,QNN accelerator (execute) time
0,BACKEND,0,COUNT,BACKEND,ROOT,Num times yield occured
0,BACKEND,699,US,BACKEND,ROOT,Time for initial VTCM acquire
0,BACKEND,18173387,CYCLES,BACKEND,ROOT,Accelerator (execute) time (cycles)
0,NODE,211078,CYCLES,BACKEND,SUB-EVENT,Input OpId_2 (cycles)
0,NODE,10697422,CYCLES,BACKEND,SUB-EVENT,matmul_node:OpId_23 (cycles)
0,NODE,0,CYCLES,BACKEND,SUB-EVENT,matmul_output_dequant:OpId_27 (cycles)
0,BACKEND,10353,US,BACKEND,ROOT,Accelerator (execute) time
0,BACKEND,10112,US,BACKEND,ROOT,Accelerator (execute excluding wait) time
0,EXECUTE,67117,US,BACKEND,ROOT,QNN (execute) time
""",
        {
            ("QNN (execute) time", "run"): (1, 67.117),
            ("RPC (execute) time", "run"): (1, 64.116),
            ("QNN accelerator (execute) time", "run"): (1, 63.551),
            ("Accelerator (execute) time", "run"): (1, 10.353),
            ("Accelerator (execute excluding wait) time", "run"): (1, 10.112),
        },
    ),
    # A guide to qnn-profile-viewer of QAIRT 2.47 (tiny_llm_block): header and rows.
    "qnn-profile-viewer": Public(
        "Input Log File Location: qnn-profiling-data_0.log\nqnn-profile-viewer version: 2.47\n\n"
        + HEADER.replace(",", ", ")
        + """0,INIT,256364,US,BACKEND,ROOT,QNN (init) time
0,EXECUTE,3301,US,NETRUN,ROOT,Graph 0: tiny_block_decode
0,EXECUTE,1851,US,BACKEND,ROOT,QNN accelerator (execute) time
0,EXECUTE,149241,CYCLES,BACKEND,ROOT,Accelerator (execute) time (cycles)
0,EXECUTE,13807,CYCLES,BACKEND,SUB-EVENT,_Transpose_3:OpId_119 (cycles)
0,EXECUTE,7492,CYCLES,BACKEND,SUB-EVENT,_MatMul_3:OpId_120 (cycles)
0,EXECUTE,3278,US,BACKEND,ROOT,QNN (execute) time
0,EXECUTE IPS,214.8888,INF/SEC,NETRUN,ROOT,NetRun IPS
""",
        {
            ("NetRun (execute) time", "run"): (1, 3.301),
            ("QNN (execute) time", "run"): (1, 3.278),
            ("QNN accelerator (execute) time", "run"): (1, 1.851),
        },
    ),
    # A reader of the CSV of ONNX Runtime 1.29 and its test (teoplaydor, semsearch): the whole first, unnamed.
    "qnn, the whole first": Public(
        HEADER
        + """UNKNOWN,EXECUTE,3100,US,BACKEND,ROOT,NULL
UNKNOWN,BACKEND,2800,US,BACKEND,SUB-EVENT,Accelerator (execute) time
UNKNOWN,NODE,6000,CYCLES,BACKEND,SUB-EVENT,matmul
UNKNOWN,EXECUTE,3100,US,BACKEND,ROOT,NULL
UNKNOWN,BACKEND,2800,US,BACKEND,SUB-EVENT,Accelerator (execute) time
UNKNOWN,NODE,6000,CYCLES,BACKEND,SUB-EVENT,matmul
""",
        {("QNN (execute) time", "run"): (2, 3.1), ("Accelerator (execute) time", "run"): (2, 2.8)},
    ),
    # microsoft/onnxruntime issue 1297, ONNX Runtime 0.4.0: nodes have no names.
    "onnxruntime 0.4": Public(
        """[
{"cat" : "Session","pid" :7838,"tid" :7838,"dur" :30779,"ts" :13,"ph" : "X","name" :"model_loading_uri","args" : {}},
{"cat" : "Node","pid" :1,"tid" :1,"dur" :1,"ts" :9,"ph" : "X","name" :"_fence_before","args" : {"op_name" : "Conv"}},
{"cat" : "Node","pid" :1,"tid" :1,"dur" :12944,"ts" :9,"ph" : "X","name" :"_kernel_time","args" : {"op_name" : "Conv"}},
{"cat" : "Node","pid" :1,"tid" :1,"dur" :9342,"ts" :109763,"ph" : "X","name" :"_kernel_time",\
"args" : {"op_name" : "BatchNormalization"}}
""",
        {("Conv", "layer"): (1, 12.944), ("BatchNormalization", "layer"): (1, 9.342)},
    ),
    # microsoft/onnxruntime issue 24306: DirectML, events without args
    "onnxruntime, directml": Public(
        """[{"cat" : "Node","pid" :1,"tid" :1,"dur" :378,"ts" :1,"ph" : "X","name" :"DmlFusedNode_0_41_kernel_time"},
{"cat" : "Node","pid" :27840,"tid" :1980,"dur" :661,"ts" :1261591,"ph" : "X","name" :"/0/0.0/STFT_kernel_time"},
{"cat" : "Session","pid" :1,"tid" :1,"dur" :10417,"ts" :1260828,"ph" : "X","name" :"SequentialExecutor::Execute"},
{"cat" : "Session","pid" :27840,"tid" :1980,"dur" :31038,"ts" :1253564,"ph" : "X","name" :"model_run"}]""",
        {
            ("model_run", "run"): (1, 31.038),
            ("SequentialExecutor::Execute", "run"): (1, 10.417),
            ("DmlFusedNode_0_41", "layer"): (1, 0.378),
            ("/0/0.0/STFT", "layer"): (1, 0.661),
        },
    ),
    # Notes on silero-vad with ONNX Runtime 1.12.1: a node of 6 us behind a fence of 0 us
    "onnxruntime 1.12": Public(
        """[
{"cat" : "Node","pid" :34575,"tid" :34575,"dur" :0,"ts" :59304,"ph" : "X","name" :"/stft/padding/Pad_fence_before"},
{"cat" : "Node","pid" :34575,"tid" :34575,"dur" :6,"ts" :59304,"ph" : "X","name" :"/stft/padding/Pad_kernel_time",\
"args" : {"thread_scheduling_stats" : "","output_size" : "2560","provider" : "CPUExecutionProvider","op_name" : "Pad"}}
]""",
        {("/stft/padding/Pad", "layer"): (1, 0.006)},
    ),
    # tensorflow/tensorflow issue 56301: logcat of Android
    "benchmark_model, logcat": Public(
        """05-30 15:16:44.858  3380  3380 I tflite  : Running benchmark for at least 1 iterations and
05-30 15:16:45.362  3380  3380 I tflite  : count=40 first=32942 curr=12594 min=11340 max=32942 avg=12581.9 std=3331
05-30 15:16:45.362  3380  3380 I tflite  : Running benchmark for at least 50 iterations and at least 1 seconds
05-30 15:16:46.365  3380  3380 I tflite  : count=75 first=12840 curr=11853 min=11787 max=13649 avg=12167.6 std=325
05-30 15:16:46.366  3380  3380 I tflite  : Inference timings in us: Init: 126059, First inference: 32942, \
Warmup (avg): 12581.9, Inference (avg): 12167.6
""",
        {("benchmark", "run"): (75, 12.1676)},
    ),
    # yuenshome/yuenshome.github.io issue 77: 2019, two benchmarks, `Average inference timings`
    "benchmark_model, 2019": Public(
        """Loaded model /data/local/tmp/tflite/tfmodel/mobilenet_v1_1.0_224_quant.tflite
Running benchmark for at least 4 iterations and at least 0.5 seconds
count=7 first=127425 curr=66709 min=66709 max=127425 avg=76605.9 std=20944

Running benchmark for at least 10 iterations and at least 1 seconds
count=15 first=66753 curr=66800 min=66699 max=66838 avg=66767.6 std=39

Average inference timings in us: Warmup: 76605.9, Init: 9933, no stats: 66767.6
""",
        {("benchmark", "run"): (15, 66.7676)},
    ),
    # Notes on TFLite 2.4 in an emulated board: one warm-up, exponents
    "benchmark_model, exponents": Public(
        """Graph: [./mobilenet_v1_1.0_224.tflite]
Running benchmark for at least 1 iterations and at least 0.5 seconds but terminate if exceeding 150 seconds.
count=1 curr=3512391

Running benchmark for at least 50 iterations and at least 1 seconds but terminate if exceeding 150 seconds.
count=50 first=2990275 curr=2913402 min=2727568 max=3189954 avg=2.95034e+06 std=109798

Inference timings in us: Init: 17187, First inference: 3512391, Warmup (avg): 3.51239e+06, Inference (avg): 2.95034e+06
""",
        {("mobilenet_v1_1.0_224.tflite", "run"): (50, 2950.34)},
    ),
    # An Arm learning path on LiteRT and SME2: the block repeats the line of figures in ms
    "benchmark_model of litert": Public(
        """taskset 80 ./benchmark_model --graph=./fc_fp32.tflite --num_runs=1000
INFO: Running benchmark for at least 1 iterations and at least 0.5 seconds but terminate if exceeding 150 seconds.
INFO: count=1055 first=1033 curr=473 min=443 max=1033 avg=465.319 std=18 p5=459 median=463 p95=478

INFO: Running benchmark for at least 1000 iterations and at least 1 seconds but terminate if exceeding 150 seconds.
INFO: count=2112 first=463 curr=459 min=442 max=979 avg=464.545 std=13 p5=460 median=462 p95=478

========== BENCHMARK RESULTS ==========
INFO: [./litert/tools/benchmark_litert_model.h:86] Warmup (avg):         0.47 ms (1055 runs)
INFO: [./litert/tools/benchmark_litert_model.h:88] Inference (avg):      0.46 ms (2112 runs)
INFO: [./litert/tools/benchmark_litert_model.h:92] Inference (min):      0.44 ms
INFO: [./litert/tools/benchmark_litert_model.h:94] Inference (max):      0.98 ms
INFO: [./litert/tools/benchmark_litert_model.h:96] Inference (std):      0.01
============================== Run Order ==============================
\t                             [node type]\t  [first]\t [avg ms]\t     [%]\t  [cdf%]\t  [mem KB]\t[times called]\t[Name]
\t Fully Connected (NC, PF32) GEMM\t    0.538\t    0.382\t 92.948%\t 97.018%\t     0.000\t        1\tDelegate/GEMM:1

============================== Top by Computation Time ==============================
\t                             [node type]\t  [first]\t [avg ms]\t     [%]\t  [cdf%]\t  [mem KB]\t[times called]\t[Name]
\t Fully Connected (NC, PF32) GEMM\t    0.538\t    0.382\t 92.948%\t 92.948%\t     0.000\t        1\tDelegate/GEMM:1
Timings (microseconds): count=3166 first=947 curr=406 min=390 max=947 avg=411.071 std=14
Memory (bytes): count=0
""",
        {
            ("fc_fp32.tflite", "run"): (2112, 0.464545),
            ("fc_fp32.tflite, sum of operators", "run"): (3166, 0.411071),
            ("Fully Connected (NC, PF32) GEMM Delegate/GEMM:1", "layer"): (None, 0.382),
        },
    ),
    # The README of litert-benchmark, in Python
    "litert-benchmark": Public(
        """========================================
 BENCHMARK RESULTS
Warmup (avg):          98.76 ms (5 runs)
Inference (avg):       85.23 ms (50 runs)
Inference (min):       82.10 ms
Inference (max):       92.45 ms
Inference (median):    84.50 ms
Inference (std):       3.21 ms
Inference (p5):        82.50 ms
Inference (p95):       91.00 ms
""",
        {("benchmark", "run"): (50, 85.23)},
    ),
    # A log of MLPerf's mobile benchmark on ADE20K, version 0.7: `Single Stream`, `Performance`
    "loadgen 0.7": Public(
        """MLPerf Results Summary
SUT name : TFLite
Scenario : Single Stream
Mode     : Performance
90th percentile latency (ns) : 141426994
Result is : VALID
QPS w/o loadgen overhead        : 7.73
Min latency (ns)                : 121304127
Max latency (ns)                : 206884343
Mean latency (ns)               : 129386553
50.00 percentile latency (ns)   : 124973763
99.90 percentile latency (ns)   : 206884343
""",
        {("TFLite", "run"): (None, 129.386553)},
    ),
    # mlcommons/mobile_results_v2.1, closed/Samsung/results/mobileBERT/SingleStream/log_performance
    "loadgen 2.0": Public(
        """MLPerf Results Summary
SUT name : samsung
Scenario : SingleStream
Mode     : PerformanceOnly
90th percentile latency (ns) : 9156602
 * Processed at least 64 queries (6605).
QPS w/o loadgen overhead        : 110.09
Min latency (ns)                : 9005742
Max latency (ns)                : 10657187
Mean latency (ns)               : 9083760
50.00 percentile latency (ns)   : 9075078
95.00 percentile latency (ns)   : 9183633
""",
        {("samsung", "run"): (6605, 9.08376)},
    ),
    # A tutorial on GPT-J in MLPerf: 3 s for a query, and a rate with two digits
    "loadgen, slow queries": Public(
        """MLPerf Results Summary
SUT name : PySUT
Scenario : SingleStream
Mode     : PerformanceOnly
 * Processed at least 64 queries (201).
QPS w/o loadgen overhead        : 0.33
Min latency (ns)                : 881803157
Max latency (ns)                : 5939081711
Mean latency (ns)               : 3008773902
""",
        {("PySUT", "run"): (201, 3008.773902)},
    ),
    # mlcommons/mobile_results_v5.0, SD8Elite/image_classification_offline_v2-performance
    "loadgen, offline": Public(
        """MLPerf Results Summary
SUT name : snpe
Scenario : Offline
Mode     : PerformanceOnly
Samples per second: 1992.95
Min latency (ns)                : 12331497965
Max latency (ns)                : 12331497965
Mean latency (ns)               : 12331497965
""",
        {("snpe", "wall"): (None, 12331.497965)},
    ),
    # mlcommons/mobile_results_v4.0, closed/Samsung/results/exynos2400/result.json
    "mlperf app 4.0": Public(
        """{"results": [{"benchmark_id": "super_resolution", "loadgen_scenario": "SingleStream",
"backend_settings": {"accelerator_desc": "NPU"}, "performance_run": {"throughput": {"value": 139.8479153920112},
"loadgen": {"query_count": 9034, "latency_mean": 0.00664158, "latency90": 0.007150625, "is_result_valid": true}}}]}""",
        {("super_resolution", "run"): (9034, 6.64158)},
    ),
    # mlcommons/mobile_results_v3.0, closed/Qualcomm_Innovation_Center/results/SD8G2/results.json: no latencies
    "mlperf app 3.0": Public(
        """{"results": [{"benchmark_id": "super_resolution", "loadgen_scenario": "SingleStream",
"performance_run": {"throughput": {"value": 105.37986332020968}, "measured_duration": 60.56878662109375,
"measured_samples": 6436, "loadgen_info": {"validity": true, "duration": 59.99605089200001}}},
{"benchmark_id": "image_classification_offline", "loadgen_scenario": "Offline", "performance_run":
{"throughput": {"value": 5226.0}, "measured_samples": 24576, "loadgen_info": {"validity": true, "duration": 4.7}}}]}""",
        {("super_resolution", "run"): (6436, 59996.05089200001 / 6436)},
    ),
    # mlcommons/mobile_results_v2.1, closed/Samsung/results/results.json: a list. LoadGen's mean is 9.08376 ms.
    "mlperf app 2.0": Public(
        """[{"results": [{"benchmark_id": "LU_float32", "loadgen_scenario": "SingleStream",
"backend_settings": {"accelerator_desc": "npu"}, "performance_run": {"throughput": 109.21081972167997,
"measured_duration_ms": 59998.24609375, "measured_samples": 6605, "loadgen_validity": true}}]}]""",
        {("LU_float32", "run"): (6605, 59998.24609375 / 6605)},
    ),
    # A note on trtexec and its engine's layers (fpn_dilate16_conv128): layers of 0 ms
    "tensorrt, layers of 0 ms": Public(
        """[
  { "count" : 625 }
, { "name" : "Conv_0 + PWN(Clip_3)", "timeMs" : 41.4232, "averageMs" : 0.0662771, "percentage" : 1.36062 }
, { "name" : "Reformatting CopyNode for Input Tensor 0", "timeMs" : 0, "averageMs" : 0, "percentage" : 0 }
]""",
        {
            ("Conv_0 + PWN(Clip_3)", "layer"): (625, 0.0662771),
            ("Reformatting CopyNode for Input Tensor 0", "layer"): (625, 0.0),
            ("all layers", "run"): (625, 0.0662771),
        },
    ),
    # A course on TensorRT (sample-cbr), its build_profile.log: with medians
    "tensorrt, medians": Public(
        """[
  { "count" : 41400 }
, { "name" : "/conv1/Conv + /act1/Relu", "timeMs" : 1160.78, "averageMs" : 0.0280382, "medianMs" : 0.027872, \
"percentage" : 100 }
]""",
        {("/conv1/Conv + /act1/Relu", "layer"): (41400, 0.0280382), ("all layers", "run"): (41400, 0.0280382)},
    ),
    # A profile of YOLOv8 that a script keeps: one run, no count
    "tensorrt, no count": Public(
        """[{ "name" : "/model.0/conv/Conv", "timeMs" : 0.03584, "averageMs" : 0.03584, "percentage" : 0.999857 }
, { "name" : "PWN(/model.0/act/Mul)", "timeMs" : 0.044032, "averageMs" : 0.044032, "percentage" : 1.2284 }]""",
        {
            ("/model.0/conv/Conv", "layer"): (None, 0.03584),
            ("PWN(/model.0/act/Mul)", "layer"): (None, 0.044032),
            ("all layers", "run"): (None, 0.079872),
        },
    ),
    # A test of AI Hub Models' export scripts, whose profile is abridged: layers as an empty table
    "ai hub, abridged": Public(
        """{"execution_detail": {}, "execution_summary": {"inference_memory_peak_range": [50000, 100000],
"estimated_inference_time": 10000, "peak_memory_bytes": 12000}}""",
        {("estimated_inference_time", "run"): (None, 10.0)},
    ),
    # A test of a reader of AI Hub's profiles, five runs; and a layer of a study of FP32 on the HTP, in cycles alone
    "ai hub, cycles": Public(
        """{"execution_summary": {"all_inference_times": [16000, 16100, 15900, 16200, 15800], "estimated_inference_time"
:15800, "estimated_inference_peak_memory": 38809600}, "execution_detail": [{"name":
"QNN_DATATYPE_FLOAT_32_converted_input_QNN_DATATYPE_FLOAT_16", "compute_unit": "NPU", "execution_cycles": 35758}]}""",
        {("all_inference_times", "run"): (5, 16.0), ("estimated_inference_time", "run"): (None, 15.8)},
    ),
    # mlcommons/mobile_results_v3.0, SDCX8G3_DC/EDSR, mlperf_log_trace.json: LoadGen writes events that are no JSON
    "loadgen's trace": Public(
        """{"traceEvents":[
{"name":"Gather","ph":"X","pid":3704,"tid":9696,"ts":-9722.600,"dur":2.000,"args":{}},
{"name":"LogDetail","ph":"X","pid":3704,"tid":9696,"ts":15841.700,"dur":17.900,"args":{"key":""loadgen_version""}},
{"name":"Wait","ph":"X","pid":3704,"tid":9696,"ts":-9709.400,"dur":25449.600,"args":{}},
""",
        {("Gather", "wall"): (1, 0.002), ("Wait", "wall"): (1, 25.4496)},
        ("line 3",),
    ),
    # PyTorch's profiler (Kineto), a sample in a README
    "kineto": Public(
        """{"schemaVersion": 1, "traceEvents": [{"ph":"X","cat":"cpu_op","name":"compute","pid":47034,"tid":189994,
"ts":6360605645266.826,"dur":46.417}]}""",
        {("compute", "wall"): (1, 0.046417)},
    ),
    # google/perfetto, diff_tests/parser/json: an end with another name ends nothing; events without a thread; cut off
    "chrome, names that differ": Public(
        """[{"ph": "B", "pid": 10, "tid": 11, "ts": 100, "name": "BeginEvent"},
{"ph": "E", "pid": 10, "tid": 11, "ts": 200, "name": "EndEvent"},
{"ph": "X", "ts": 970, "dur": 10, "name": "NoPidNoTidEvent"}]""",
        {("NoPidNoTidEvent", "wall"): (1, 0.01)},
    ),
    "chrome, cut off": Public(
        """
        [
        {"name":"typecheck","ph":"X","ts":4619295550.000,"dur":8000.000,"pid":306339,"tid":3},
""",
        {("typecheck", "wall"): (1, 8.0)},
    ),
}


def timed(found: Measurements) -> dict[tuple[str, str], tuple[int | None, float]]:
    return {
        (each.name, each.kind): (each.count, each.mean_ms) for each in found.measurements if each.mean_ms is not None
    }


@pytest.mark.parametrize("name", PUBLIC)
def test_what_is_read_is_what_the_source_states(name: str, read: Callable[[str], Measurements]) -> None:
    public = PUBLIC[name]
    found = read(public.text)
    assert timed(found).keys() == public.timed.keys()
    for key, (count, mean) in public.timed.items():
        assert timed(found)[key] == (count, pytest.approx(mean, rel=1e-9)), key
    assert [each.row for each in found.refused] == list(public.refused)


def test_an_older_app_s_mean_is_that_of_loadgen(read: Callable[[str], Measurements]) -> None:
    """The app's result and LoadGen's summary of one run, published side by side, agree to 0.3 us."""
    of_app = chosen(read(PUBLIC["mlperf app 2.0"].text), "", "x")
    of_loadgen = chosen(read(PUBLIC["loadgen 2.0"].text), "", "x")
    assert of_app.mean_ms == pytest.approx(of_loadgen.mean_ms, abs=3e-4)
    assert "measured_duration_ms by measured_samples" in of_app.what


def test_the_app_s_figures_are_said(read: Callable[[str], Measurements]) -> None:
    assert read(PUBLIC["mlperf app 4.0"].text).says.startswith(
        "of each benchmark the mean latency as LoadGen states it;"
    )
    older = PUBLIC["mlperf app 3.0"].text
    divided = {("super_resolution", "run"): (6436, 59996.05089200001 / 6436)}
    assert read(older).says.startswith("of each benchmark the duration of the run by its number of samples;")
    in_ms = read(older.replace('"duration": 59.99605089200001', '"duration_ms": 59996.05089200001'))
    assert timed(in_ms) == {key: (count, pytest.approx(mean)) for key, (count, mean) in divided.items()}
    stated = read(older.replace('"duration": 59.99605089200001', '"latency_mean": 0.009, "latency90": 0.0095'))
    assert timed(stated) == {("super_resolution", "run"): (None, 9.0)}
    assert stated.says.startswith("of each benchmark the mean latency")


def test_nodes_of_a_viewer_are_shares(read: Callable[[str], Measurements]) -> None:
    nodes = [each for each in read(PUBLIC["qnn-profile-viewer"].text).measurements if each.kind == "layer"]
    assert {each.name: each.share for each in nodes} == {
        "_Transpose_3:OpId_119 (cycles)": pytest.approx(13807 / 21299),
        "_MatMul_3:OpId_120 (cycles)": pytest.approx(7492 / 21299),
    }


def test_the_figures_before_a_block_stay_and_must_fit_it(read: Callable[[str], Measurements]) -> None:
    text = PUBLIC["benchmark_model of litert"].text
    (one,) = [each for each in read(text).measurements if each.name == "fc_fp32.tflite"]
    assert (one.sd_ms, one.p50_ms, one.p95_ms, one.max_ms) == (0.013, 0.462, 0.478, 0.979)
    found = read(text.replace("Inference (avg):      0.46", "Inference (avg):      4.60"))
    assert [each.row for each in found.refused] == ["line 6: fc_fp32.tflite"]
    assert "line 10 says Inference (avg): 4.6 ms" in found.refused[0].reason


#: name of a file -> what is replaced, by what, a row of the refusal, a word of its reason
BROKEN: list[tuple[str, str, str, str, str]] = [
    ("qnn-profile-viewer", "3301,US", "1301,US", "NETRUN|NetRun", "shorter than"),
    ("qnn-profile-viewer", "3301,US", "x,US", "line 6: NetRun (execute) time", "a number was expected"),
    (
        "qnn, the whole first",
        "2800,US",
        "28000,US",
        "line 2: QNN (execute) time",
        "shorter than 'Accelerator (execute)",
    ),
    ("loadgen 0.7", "Single Stream", "Double Stream", "line 3", "none of"),
    ("loadgen 0.7", ": Performance", ": Accuracy", "line 4: Mode", "a run for accuracy"),
    ("loadgen, slow queries", ": 3008773902", ": 3008773", "line 9: Mean latency (ns)", "below the least"),
    ("loadgen, slow queries", ": 0.33", ": 330", "line 9: Mean latency (ns)", "a unit is wrong"),
    ("mlperf app 4.0", "139.8479", "139847.9", "results[0]: super_resolution", "a unit is wrong"),
    ("mlperf app 4.0", "0.007150625", "7.150625", "results[0]: super_resolution", "a unit is wrong"),
    (
        "mlperf app 3.0",
        '"duration": 59.99605089200001',
        '"duration": -1',
        "results[0]: super_resolution",
        "performance_run.loadgen_info.duration is negative",
    ),
    (
        "mlperf app 3.0",
        '"duration": 59.99605089200001',
        '"duration": 59996',
        "results[0]: super_resolution",
        "a unit is",
    ),
    (
        "mlperf app 3.0",
        ', "duration": 59.99605089200001',
        "",
        "results[0]",
        "no performance_run.loadgen_info.duration:",
    ),
    ("mlperf app 3.0", '"measured_samples": 6436', '"measured_samples": 0', "super_resolution", "query_count is 0"),
    (
        "mlperf app 2.0",
        "59998.24609375",
        "null",
        "results[0]: LU_float32",
        "no performance_run.measured_duration_ms: give mlperf_log_summary.txt",
    ),
]


@pytest.mark.parametrize("case", BROKEN, ids=lambda case: f"{case[0]}: {case[2]}")
def test_a_broken_row_of_another_version_is_named(
    case: tuple[str, str, str, str, str], read: Callable[[str], Measurements]
) -> None:
    name, old, new, row, reason = case
    text = PUBLIC[name].text
    assert text.count(old) >= 1
    try:
        said = [f"{each.row}: {each.reason}" for each in read(text.replace(old, new, 1)).refused]
    except BadInputError as error:
        said = [str(error)]
    assert any(any(word in each for word in row.split("|")) and reason in each for each in said), said


def test_a_second_summary_in_one_file_is_named(read: Callable[[str], Measurements]) -> None:
    found = read(PUBLIC["loadgen 2.0"].text + PUBLIC["loadgen 0.7"].text)
    assert timed(found) == PUBLIC["loadgen 2.0"].timed
    assert [each.row for each in found.refused] == ["line 13"]


def test_a_line_without_an_end_costs_no_more_than_its_length(read: Callable[[str], Measurements]) -> None:
    """A pattern that tried each beginning and end of a name took minutes for such a line."""
    text = "a " * 100_000 + "\n" + PUBLIC["loadgen 2.0"].text
    assert timed(read(text)) == PUBLIC["loadgen 2.0"].timed


def test_a_distribution_with_a_long_tail_is_no_wrong_unit(read: Callable[[str], Measurements]) -> None:
    """The app's throughput is one over the 90th percentile, which may be twice the mean."""
    text = PUBLIC["mlperf app 4.0"].text.replace("0.00664158", "0.0035")
    assert timed(read(text)) == {("super_resolution", "run"): (9034, 3.5)}
