"""Why a run's picture is not the reference's: the causes, in the order of the data, and what each needs beside it.

Rule: plain data. A cause that cannot stand alone in the reference says which others have to be there: bytes for a
runtime, the run's tensor for the stages that draw into it or read from it.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Cause(StrEnum):
    """In the order in which they are added."""

    WEIGHTS = "skin weights"
    BLEND = "blend shapes"
    FLOAT32 = "FP32 transforms"
    FLOAT16 = "FP16 texture"
    CROP = "crop and size"
    READS = "one read a pixel"
    PACKING = "INT8 packing"
    RASTER = "GPU raster"
    QUANTISATION = "quantisation"
    RUNTIME = "runtime"
    COMPOSITE = "composite"


Causes = frozenset[Cause]
NOTHING: Causes = frozenset()
BODY: Causes = frozenset({Cause.WEIGHTS, Cause.BLEND, Cause.FLOAT32})
_DRAWN = BODY | {Cause.FLOAT16, Cause.CROP, Cause.READS, Cause.PACKING}

NEEDS: dict[Cause, Causes] = {
    Cause.RASTER: _DRAWN,
    Cause.RUNTIME: frozenset({Cause.PACKING, Cause.QUANTISATION}),
    Cause.COMPOSITE: frozenset({Cause.CROP}),
}

WHAT: dict[Cause, str] = {
    Cause.WEIGHTS: "the run's skin weights instead of all; hands and face at rest where the plan says so",
    Cause.BLEND: "pose blend shapes left out where the plan says so; in FP16 where the GPU unit skins",
    Cause.FLOAT32: "joints, vertices and camera in float32",
    Cause.FLOAT16: "the neural texture in float16",
    Cause.CROP: "the run's tensor and crop rectangles instead of a tensor for each avatar on the picture's grid",
    Cause.READS: "one read of the texture for each tensor pixel instead of the mean of 4 x 4",
    Cause.PACKING: "the tensor rounded and clamped to bytes",
    Cause.RASTER: "the GPU unit's own tensor instead of the float64 rasteriser's with all of the above",
    Cause.QUANTISATION: "the integer network, as its file says it, instead of the FP32 network",
    Cause.RUNTIME: "the integer network as the run's runtime computes it",
    Cause.COMPOSITE: "the composite stage instead of float64; the network's picture in bytes",
}


def needs(cause: Cause) -> Causes:
    """What has to be there for `cause` to be switched on."""
    return NEEDS.get(cause, NOTHING)


def up_to(cause: Cause) -> Causes:
    """`cause` and all before it."""
    order = list(Cause)
    return frozenset(order[: order.index(cause) + 1])


def require_complete(causes: Iterable[Cause]) -> Causes:
    """`causes` as a set. Raises ValueError when one lacks what it needs."""
    found = frozenset(causes)
    for cause in found:
        if missing := needs(cause) - found:
            raise ValueError(f"{cause} needs {', '.join(sorted(missing))}")
    return found
