"""What the options of the benches mean, by name.

Rule: an option means the same in every bench, or has a line of its own for the bench where it does not. The options
themselves are the parameters of each bench's `measure`.
"""

from __future__ import annotations

from trilane.apps.cli.options import ENCODER_HELP, NORM_HELP, POLICY_HELP, RUNTIME_HELP, SIZE_HELP, WIDTH_HELP

FIXED_SIZE = "Tensor size in pixels: HEIGHTxWIDTH."
SQUARE_SIZE = "Side of the square tensor in pixels."
NAMED_RUNTIME = "ort, openvino, qnn or cuda."
DRIVER_THREADS = "Threads of the software OpenGL driver."

#: Option, or bench and option: its line in `--help`.
MEANINGS = {
    "avatar": "`default`, `hiker`, the folder of an avatar, or `resnet18`: the full-width network, untrained.",
    "avatars": "How many avatars share the tensor.",
    "beside": "A second avatar, run at the same time and set beside the virtual clock.",
    "beside_size": "Tensor size of the second avatar in pixels: HEIGHTxWIDTH, or a side.",
    "batch": "Frames inferred at once.",
    "calibration": "as-it-is, or the network quantised anew: minmax, percentile or entropy.",
    "channels": "Channels of the neural texture: 4, 8, 12 or 16.",
    "cores": "Cores of the three units together; 0: all that this process may use.",
    "edge": "Buffers between stages: single, double, triple, fifo:N, orphan or orphan:N.",
    "encoder": ENCODER_HELP,
    "events": "Folder of a run, or its events.jsonl, to be replayed.",
    "fault": "kill (SIGKILL at random moments) or stop (SIGSTOP once).",
    "fps": "Frames released a second.",
    "frames": "Frames of each run.",
    "predict avatar": "`default`, `hiker`, or the folder of an avatar.",
    "predict frames": "Frames of each run, at least 100.",
    "predict seconds": "How long each network is called by itself.",
    "predict width": "Width of a further network, untrained; 64 is full.",
    "handoff frames": "Hand-overs in each round, of each variant and size.",
    "hang_s": "Seconds without a heartbeat after which a unit is restarted.",
    "height": "Height of the picture in pixels.",
    "judge": "Who evaluates the run: trilane or loadgen.",
    "kib": "Size of the slot in KiB: 256, 1024, 4096 or 16384.",
    "limit_ms": "Longest latency of the server scenario that counts as in time.",
    "finalists": "How many placements are measured again, beside the chosen one and that of the rule.",
    "further": "Rounds of the finalists, after those of all placements.",
    "placement frames": "Frames of each whole run, at least 20.",
    "placement runs": "Whole runs of the chosen placement and of the rule's.",
    "margins": "Pixels of the tensor between two avatars.",
    "minutes": "Virtual minutes.",
    "network": "An .onnx file or an avatar, at its own size; if none, one of --encoder, --norm, --width and --size.",
    "norm": NORM_HELP,
    "pairs": "How many pairs of runs of one kind.",
    "period": "Seconds that one runtime runs before the next one does.",
    "policy": POLICY_HELP,
    "rate": "Queries a second of the server scenario.",
    "repeats": "How often each variant runs.",
    "joints repeats": "How many loops are timed.",
    "runs": "How many runs are drawn, for each clock.",
    "runtime": RUNTIME_HELP,
    "infer runtime": NAMED_RUNTIME,
    "samples": "Frames of a multi-stream query.",
    "out": "Folder for sheets of the pictures: full, fixed, planned; below: the truth, and differences times 8.",
    "pictures": "Frames whose image error is measured, evenly spread over the scene.",
    "planner frames": "Frames of each run, at least 20, evenly spread over the scene; all of a shorter one.",
    "sizes frames": "Frames whose error is measured, evenly spread over the scene.",
    "sizes rounds": "How often each frame is timed, by every size on every runtime in turn.",
    "sizes runtime": NAMED_RUNTIME,
    "flicker frames": "Frames that follow each other, from the first on.",
    "flicker runtime": NAMED_RUNTIME,
    "scene": "A scene that comes with Trilane, or a scene file.",
    "scenario": "single-stream, multi-stream, server or offline.",
    "seconds": "How long each run lasts.",
    "infer seconds": "How long each network runs on each runtime.",
    "peers seconds": "How long each variant runs in a round.",
    "dashboard seconds": "How long each variant runs in a round, at least 1.",
    "seed": "Seed of the random moments.",
    "seeds": "How many seeds are compared.",
    "size": SIZE_HELP,
    "sizes": "Sides of square tensors in pixels.",
    "spin": "Let the runtime's threads spin between jobs.",
    "stop_s": "Seconds that a stopped unit stands still.",
    "texture_filter": "Of the neural texture: linear, mipmap or anisotropic.",
    "threads": "Threads of the runtime; 0: one for each core that this process may use.",
    "raster threads": DRIVER_THREADS,
    "readback threads": DRIVER_THREADS,
    "times": "How often the unit is killed in a run.",
    "rounds": "Rounds: each runs every variant once.",
    "unit": "cpu, gpu or dsp.",
    "video": "Encode the video, as a run does.",
    "views": "How many random poses and views.",
    "several views": "How many moments of the motion.",
    "width": WIDTH_HELP,
    "compare frames": "Frames of each run, at least 51.",
    "compare size": "Tensor size in pixels: HxW, or a side.",
    "infer size": FIXED_SIZE,
    "peers size": FIXED_SIZE,
    "raster size": SQUARE_SIZE,
    "raster-oracle size": SQUARE_SIZE,
    "steps": "Steps of each training, of four views each; at least 10.",
    "look": "Synthetic person: default, or hiker, whom the network that training starts from never saw.",
    "augmentation frames": "Frames of the capture, at least 4.",
    "augmentation samples": "Views of them that are drawn for each training, at least 8.",
    "augmentation views": "Held-out views of each band of zoom.",
    "augmentation seed": "Seed of the capture, of its views and of the held-out ones.",
    "crop width": "Width of the picture in pixels.",
}


def meaning(bench: str, option: str) -> str:
    """The line for `option` of `bench`. Raises KeyError for an option without one."""
    return MEANINGS.get(f"{bench} {option}") or MEANINGS[option]
