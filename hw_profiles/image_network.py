"""A graph as the network of the application: it is given a picture that the raster stage draws.

Rule: the shape of the one input says it all; of its two possible orders, the one with fewer channels is meant.
"""

from __future__ import annotations

from trilane.errors import BadInputError
from trilane.hw_profiles.graph_file import GraphFile
from trilane.hw_profiles.network_work import Network, constant_tensors

MOST_CHANNELS = 64


def image_network(graph: GraphFile, layout: str) -> Network:
    """The network with its work and the size of its picture.

    `graph`: of a file.
    `layout`: of the raster stage: `packed` or `split`.
    Raises BadInputError unless the graph has one input, a picture.
    """
    weights = constant_tensors(graph.model.graph)
    shapes = [
        tuple(dim.dim_value for dim in value.type.tensor_type.shape.dim)
        for value in graph.model.graph.input
        if value.name not in weights
    ]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][0] != 1 or min(shapes[0][1], shapes[0][3]) > MOST_CHANNELS:
        found = ", ".join("x".join(map(str, shape)) for shape in shapes)
        expected = f"one picture for the application: 1xCxHxW or 1xHxWxC, C at most {MOST_CHANNELS}"
        raise BadInputError(graph.path, f"inputs {found}", expected, "without --application it is predicted by itself")
    _, first, second, third = shapes[0]
    height, width, channels = (second, third, first) if first <= third else (first, second, third)
    return Network({"network": str(graph.path)}, height, width, channels, layout, graph.work)
