"""Every usual network is priced without a refusal: the published graphs, what Trilane writes, what others export."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.hw_profiles.graph_file import read_graph
from trilane.hw_profiles.network_time import INSIDE, in_precision, predict_network
from trilane.hw_profiles.network_work import Work, count_work
from trilane.hw_profiles.operators import KIND_OF, has_rule
from trilane.hw_profiles.profile_files import load_profile
from trilane.hw_profiles.reference_networks import NetworkSpec, build_network
from trilane.training.quantising.quantise import Quantised
from trilane.unet_tables import ENCODERS, NORMS

FLOAT = TensorProto.FLOAT


def priced(path: Path) -> Any:
    graph = read_graph(path)
    return predict_network(in_precision(load_profile("snapdragon-888"), "dsp", graph.numbers), graph, "dsp")


def test_the_published_graphs_are_priced_and_counted(shared_data: Path) -> None:
    """Products and parameters as networks.csv has them, which has them from the graphs' sources.

    It counts mean and variance of a batch normalisation too, which are not learned.
    """
    with (shared_data / "chips" / "networks.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 32
    for row in rows:
        path = shared_data / "chips" / "networks" / f"{row['name']}.onnx"
        found = priced(path)
        graph = onnx.load(path).graph
        sizes = {i.name: i.type.tensor_type.shape.dim[0].dim_value for i in graph.input}
        means = sum(2 * sizes[node.input[3]] for node in graph.node if node.op_type == "BatchNormalization")
        assert found.gmac == pytest.approx(float(row["gmac"]), abs=1e-4), row["name"]
        assert found.parameters_m == pytest.approx(float(row["params_m"]) - means / 1e6, abs=2e-4), row["name"]
        assert found.without_rule == (), row["name"]
        assert found.low_ms < found.network_ms < found.high_ms
        assert all(operator.ms >= 0 for operator in found.operators)


def saved(model: onnx.ModelProto, folder: Path) -> Path:
    path = folder / "net.onnx"
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("norm", NORMS)
def test_the_reference_networks_are_priced(norm: str, tmp_path: Path) -> None:
    for encoder in ENCODERS:
        for layout in ("packed", "split"):
            model = build_network(NetworkSpec(encoder, norm, 64, 96, 12, layout))
            found = priced(saved(model, tmp_path))
            assert found.numbers == "not said"
            assert (found.without_rule, found.gmac) == ((), count_work(model).macs / 1e9)


def test_the_networks_of_an_avatar_are_priced(
    tiny_quantised: Quantised, tiny_float: onnx.ModelProto, tmp_path: Path
) -> None:
    integer = priced(saved(tiny_quantised.network.model, tmp_path))
    plain = priced(saved(tiny_float, tmp_path))
    assert (integer.numbers, plain.numbers) == ("w8a8", "float")
    assert (integer.precision, plain.precision) == ("int8", "fp16")
    assert integer.gmac == plain.gmac > 0
    assert integer.without_rule == plain.without_rule == ()


def array(name: str, *shape: int) -> TensorProto:
    return numpy_helper.from_array(np.ones(shape, np.float32), name)


def integers(name: str, *numbers: int) -> TensorProto:
    return numpy_helper.from_array(np.array(numbers, np.int64), name)


def work_of(
    folder: Path, nodes: list[str | tuple[str, dict[str, Any]]], shape: tuple[int, ...], weights: list[TensorProto]
) -> Work:
    """Of a graph from `x` to `y`. Nodes: "Op a b -> c", with their attributes."""
    made = []
    for entry in nodes:
        text, attributes = (entry, {}) if isinstance(entry, str) else entry
        left, _, right = text.partition(" -> ")
        op_type, *inputs = left.split()
        made.append(helper.make_node(op_type, inputs, right.split(), name=right, **attributes))
    ends = [helper.make_tensor_value_info("x", FLOAT, shape), helper.make_empty_tensor_value_info("y")]
    ends[1].type.tensor_type.elem_type = FLOAT
    graph = helper.make_graph(made, "g", ends[:1], ends[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)])
    return count_work(read_graph(saved(model, folder)).model)


def counts(work: Work) -> list[tuple[str, str, int, int, int]]:
    return [(o.op_type, o.kind, o.macs, o.moved, o.weights) for o in work.operators]


def test_attention_is_counted_by_hand(tmp_path: Path) -> None:
    """Four tokens of six numbers, two heads of three; keys and values are the queries.

    The projection multiplies 4 x 6 by 6 x 6; scores are 2 x 4 x 4 with 3 products each, weighted sums 2 x 4 x 3 with 4.
    """
    work = work_of(
        tmp_path,
        [
            "MatMul x w -> q",
            "Add q bias -> b",
            "Reshape b by_head -> r",
            ("Transpose r -> h", {"perm": [0, 2, 1, 3]}),
            ("Transpose r -> k", {"perm": [0, 2, 3, 1]}),
            "MatMul h k -> s",
            ("Softmax s -> p", {"axis": -1}),
            "MatMul p h -> y",
        ],
        (1, 4, 6),
        [array("w", 6, 6), array("bias", 6), integers("by_head", 1, 4, 2, 3)],
    )
    # A permutation to (0, 2, 3, 1) is taken for a change from channels first to channels last, and costs nothing.
    assert counts(work) == [
        ("MatMul", "pointwise", 4 * 6 * 6, 24 + 24, 36),
        ("Add", "elementwise", 0, 24 + 24, 6),
        ("Transpose", "permute", 0, 24 + 24, 0),
        ("MatMul", "pointwise", 2 * 4 * 4 * 3, 24 + 24 + 32, 0),
        ("Softmax", "normalisation", 0, 2 * 32 + 32, 0),
        ("MatMul", "pointwise", 2 * 4 * 3 * 4, 32 + 24 + 24, 0),
    ]
    assert [(o.c_in, o.c_out) for o in work.operators if o.macs] == [(6, 6), (3, 4), (4, 3)]


#: Name -> (nodes, shape of x, weights, (kind, macs, moved, weights) of the only operator).
ALONE: dict[str, tuple[list[Any], tuple[int, ...], list[TensorProto], tuple[str, int, int, int]]] = {
    "a vector": (["MatMul x w -> y"], (5, 6), [array("w", 6)], ("pointwise", 5 * 6, 30 + 5, 6)),
    "Gemm, turned": (
        [("Gemm x w b -> y", {"transA": 1, "transB": 1})],
        (6, 5),
        [array("w", 7, 6), array("b", 7)],
        ("pointwise", 5 * 7 * 6, 30 + 35, 42 + 7),
    ),
    "Einsum": (
        [("Einsum x w -> y", {"equation": "bid,hdk->bhik"})],
        (2, 3, 4),
        [array("w", 5, 4, 6)],
        ("pointwise", 2 * 3 * 4 * 5 * 6, 24 + 2 * 5 * 3 * 6, 5 * 4 * 6),
    ),
    "LSTM": (
        [("LSTM x w r -> y", {"hidden_size": 3})],
        (7, 2, 4),
        [array("w", 1, 12, 4), array("r", 1, 12, 3)],
        ("pointwise", 7 * 2 * (12 * 4 + 12 * 3), 56 + 7 * 2 * 3, 48 + 36),
    ),
    "embedding": (
        ["Cast x -> i", "Gather w i -> y"],
        (1, 4),
        [array("w", 10, 6)],
        ("resize", 0, 4 + 24, 60),
    ),
    "layer norm": (
        [("LayerNormalization x s b -> y", {"axis": -1})],
        (1, 4, 6),
        [array("s", 6), array("b", 6)],
        ("normalisation", 0, 2 * 24 + 24, 12),
    ),
    "depth to space": ([("DepthToSpace x -> y", {"blocksize": 2})], (1, 8, 3, 3), [], ("resize", 0, 72 + 72, 0)),
    "split": (
        [("Split x -> a b", {"axis": 1, "num_outputs": 2}), ("Concat b a -> c", {"axis": 1}), "Identity c -> y"],
        (1, 4, 2, 2),
        [],
        ("resize", 0, 16 + 16, 0),
    ),
    "power": (["Pow x two -> y"], (1, 5), [array("two")], ("elementwise", 0, 10, 1)),
}


@pytest.mark.parametrize("name", ALONE)
def test_operators_of_transformers_are_counted_by_hand(name: str, tmp_path: Path) -> None:
    nodes, shape, weights, expected = ALONE[name]
    if name == "embedding":
        nodes = [(nodes[0], {"to": TensorProto.INT64}), nodes[1]]
    work = work_of(tmp_path, nodes, shape, weights)
    last = work.operators[-1 if name == "embedding" else 0]
    assert (last.kind, last.macs, last.moved, last.weights, last.ruled) == (*expected, True)


def test_what_follows_from_shapes_alone_costs_nothing(tmp_path: Path) -> None:
    """As exporters write a flattening: shape, gather, multiply, concatenate, reshape."""
    work = work_of(
        tmp_path,
        [
            "Shape x -> s",
            "Gather s zero -> n",
            ("Concat n minus -> t", {"axis": 0}),
            "Reshape x t -> r",
            "Sqrt w -> root",
            "Mul r root -> y",
        ],
        (2, 3, 4),
        [integers("zero", 0), integers("minus", -1), array("w", 12)],
    )
    assert counts(work) == [("Mul", "elementwise", 0, 24 + 24, 12)]


def test_a_network_quantised_by_onnx_runtime(tmp_path: Path) -> None:
    """Weights of int8 by channel, floats at both ends: the same operators and products as before."""
    quantization = pytest.importorskip("onnxruntime.quantization")

    class Frames(quantization.CalibrationDataReader):  # type: ignore[misc,name-defined]
        def __init__(self) -> None:
            self.left = [{"x": np.ones((1, 3, 16, 16), np.float32) * n} for n in range(2)]

        def get_next(self) -> Any:
            return self.left.pop() if self.left else None

    nodes = [
        helper.make_node("Conv", ["x", "w", "b"], ["c"], pads=[1] * 4),
        helper.make_node("Relu", ["c"], ["r"]),
        helper.make_node("GlobalAveragePool", ["r"], ["y"]),
    ]
    ends = [helper.make_tensor_value_info(n, FLOAT, s) for n, s in (("x", (1, 3, 16, 16)), ("y", (1, 8, 1, 1)))]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [array("w", 8, 3, 3, 3), array("b", 8)])
    plain, integer = tmp_path / "float.onnx", tmp_path / "integer.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), plain)
    quantization.quantize_static(plain, integer, Frames(), per_channel=True)
    before, after = read_graph(plain), read_graph(integer)
    assert (before.numbers, after.numbers) == ("float", "w8a8")
    first, second = count_work(before.model), count_work(after.model)
    assert [(o.op_type, o.macs, o.weights) for o in second.operators] == [
        ("Conv", 256 * 27 * 8, 27 * 8 + 8),
        ("GlobalAveragePool", 0, 0),
    ]
    assert [o.macs for o in first.operators] == [o.macs for o in second.operators]


USUAL = """
Conv ConvTranspose Gemm MatMul Relu Clip LeakyRelu PRelu Elu Selu Sigmoid Tanh HardSigmoid HardSwish Softplus Mish Gelu
Softmax LogSoftmax BatchNormalization InstanceNormalization LayerNormalization GroupNormalization LRN Erf
MaxPool AveragePool GlobalAveragePool GlobalMaxPool Resize Upsample DepthToSpace SpaceToDepth GridSample Pad
Concat Split Slice Gather GatherElements GatherND ScatterND ScatterElements Expand Tile Where Transpose Reshape Flatten
Squeeze Unsqueeze Identity Dropout Cast Shape Constant ConstantOfShape Range NonMaxSuppression
Add Sub Mul Div Pow Sqrt Exp Log Abs Neg Min Max Floor Ceil Round Reciprocal Sin Cos Equal Greater Less Not And Or
ReduceMean ReduceSum ReduceMax ReduceMin ReduceL2 ReduceProd ArgMax ArgMin TopK CumSum Trilu OneHot Einsum LSTM GRU
QuantizeLinear DequantizeLinear DynamicQuantizeLinear QLinearConv QLinearMatMul ConvInteger MatMulInteger RoiAlign
"""


def test_every_usual_operator_has_a_rule() -> None:
    """Of torchvision, of super-resolution and segmentation networks, of transformers, and of quantisers."""
    assert [name for name in USUAL.split() if not has_rule(name)] == []
    assert not has_rule("Conv", "somebody") and has_rule("Gelu", "com.microsoft")


def test_operators_are_of_onnx() -> None:
    """A misspelt row of the tables would never be found."""
    known = {schema.name for schema in onnx.defs.get_all_schemas_with_history()}
    runtimes = {name for name in KIND_OF if name not in known}
    assert all(name.startswith(("QLinear", "Skip", "Simplified", "Quick", "Fast", "Bias")) for name in runtimes), (
        runtimes
    )


def test_chains_of_sizes_are_followed_where_onnx_does_not(tmp_path: Path) -> None:
    """As an exporter writes a repeat: where the wanted sizes are -1, one, and elsewhere they themselves."""
    work = work_of(
        tmp_path,
        [
            "Shape x -> s",
            "Size s -> rank",
            "Unsqueeze rank zero -> ranks",
            ("ConstantOfShape ranks -> zeros", {"value": integers("whole", 0)}),
            "Add zeros one -> ones",
            "Equal wanted minus -> free",
            "Where free ones wanted -> sizes",
            "Expand x sizes -> e",
            "Range start stop step -> r",
            "Gather sizes r -> again",
            "Expand e again -> t",
            "Tanh t -> y",
        ],
        (2, 1, 4),
        [
            *(integers("zero", 0), integers("one", 1), integers("minus", -1), integers("wanted", -1, 3, -1)),
            *(numpy_helper.from_array(np.int64(n), name) for name, n in (("start", 0), ("stop", 3), ("step", 1))),
        ],
    )
    assert counts(work) == [
        ("Expand", "resize", 0, 8 + 24, 0),
        ("Expand", "resize", 0, 24 + 24, 0),
        ("Tanh", "elementwise", 0, 48, 0),
    ]


def test_a_compiled_network_is_said_to_hide_what_it_computes(tmp_path: Path) -> None:
    """As `trilane avatar export` writes it: one operator of ONNX Runtime, whose result has the shape that is stated."""
    ends = [helper.make_tensor_value_info(n, TensorProto.UINT8, (1, 8, 8, c)) for n, c in (("x", 16), ("y", 4))]
    node = helper.make_node("EPContext", ["x"], ["y"], name="all", domain="com.microsoft", ep_cache_context=b"\0\1")
    graph = helper.make_graph([node], "g", ends[:1], ends[1:])
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
    found = priced(saved(helper.make_model(graph, opset_imports=opsets), tmp_path))
    assert [row.as_json() for row in found.without_rule] == [
        {"op_type": "EPContext", "count": 1, "share_of_elements": 1.0}
    ]
    assert found.why[-1] == INSIDE
