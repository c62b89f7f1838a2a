"""What the options of the benches mean. Rule: a word means the same everywhere, or has a line for the bench where not.

The options themselves are the parameters of each bench's `measure`.
"""

from __future__ import annotations

#: Option, or bench and option -> its line in `--help`.
MEANINGS = {
    "avatar": "`default`, a bundle's folder, or `resnet18`: the full-width network, untrained.",
    "avatars": "How many persons share the tensor.",
    "batch": "Pictures inferred at once.",
    "channels": "Of the neural texture: 4, 8, 12 or 16.",
    "cores": "How many the three units have; 0: all.",
    "edge": "Rule of the edges: single, double, triple, fifo:N, orphan or orphan:N.",
    "encoder": "resnet18, mobilenetv2, mobilenetv3 or efficientnet-lite0.",
    "events": "A run's folder or its events.jsonl, to be replayed.",
    "fault": "kill (SIGKILL at random moments) or stop (SIGSTOP once).",
    "fps": "Frames released a second.",
    "frames": "Frames of a run.",
    "handoff frames": "Hand-overs in each turn, way and size.",
    "hang_s": "Seconds without a sign of life after which a unit is restarted.",
    "height": "Of the picture, in pixels.",
    "judge": "trilane, loadgen or both.",
    "kib": "Size of the slot: 256, 1024, 4096 or 16384.",
    "limit_ms": "Longest latency that counts as in time.",
    "margins": "Pixels of the tensor between two avatars.",
    "minutes": "Virtual minutes.",
    "network": "An .onnx file or a bundle, at its own size; else one is made of --encoder, --norm, --width and --size.",
    "norm": "batch, instance or group.",
    "period": "Seconds between two of the rates that are written down.",
    "policy": "sequential, pipelined, latest or deadline.",
    "rate": "Queries a second of the server scenario.",
    "repeats": "Repetitions; the median counts.",
    "runtime": "auto, ort, openvino, qnn or cuda.",
    "samples": "Frames of a multi-stream query.",
    "scenario": "single-stream, multi-stream, server or offline.",
    "seconds": "How long each run lasts.",
    "infer seconds": "How long each network and runtime runs.",
    "peers seconds": "How long each way runs in a turn.",
    "seed": "Of the random moments and service times.",
    "seeds": "How many seeds are compared.",
    "size": "Of the tensor: HEIGHTxWIDTH in pixels; or N, all shapes of at most N x N pixels.",
    "sizes": "Sides of square tensors, in pixels.",
    "spin": "Let the runtime's threads wait awake.",
    "stop_s": "Seconds that a stopped unit stands still.",
    "threads": "Of the runtime; 0: one for each core.",
    "raster threads": "Of the software driver.",
    "readback threads": "Of the software driver.",
    "times": "Kills in each run.",
    "turns": "Each way once a turn, in pairs.",
    "unit": "cpu, gpu or dsp.",
    "video": "Encode the video, as a run does.",
    "views": "Random poses and views.",
    "width": "Of the network: 64 is full, every channel count scales with it.",
    "infer size": "Of the tensor: HEIGHTxWIDTH in pixels.",
    "peers size": "Of the tensor: HEIGHTxWIDTH in pixels.",
    "raster size": "Side of the square tensor, in pixels.",
    "raster-oracle size": "Side of the square tensor, in pixels.",
    "crop width": "Of the picture, in pixels.",
}


def meaning(bench: str, option: str) -> str:
    """The line for `option` of `bench`. Raises KeyError for an option that nobody has described."""
    return MEANINGS.get(f"{bench} {option}") or MEANINGS[option]
