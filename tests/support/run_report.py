"""A report of a run. Rule: every figure in it is written by hand, and nothing depends on a machine."""

from __future__ import annotations

from typing import Any

from trilane.pipeline.run_metrics import RunMetrics

SHOWN = {
    "source": "from the avatar's validation of 2026-01-02",
    "runtime": "ort",
    "size": "256",
    "psnr_db_by_band": {"face": 31.25},
    "body_psnr_db": 28.75,
    "see_through": 0.0125,
    "iou": 0.9812,
    "samples": 96,
    "by_seed": {"1": {}, "2": {}},
    "worst": {"psnr_db": 21.5},
}
TIMES = {"mean": 20.0, "p50": 20.0, "p90": 21.0, "p95": 22.0, "p99": 23.0, "max": 24.0}
SHARE = {
    "busy": 0.5,
    "idle": {"starved": 0.25, "blocked": 0.15, "throttled": 0.0, "preempted": 0.02, "overhead": 0.08},
    "jobs": 3,
    "restarts": 0,
    "pid": 7,
    "cores": [2, 3],
    "threads": 2,
    "spin": True,
}
MACHINE = {
    "system": "Linux",
    "python": "3.11",
    "trilane": None,
    "cpu": {
        "model": "a processor",
        "architecture": "x86_64",
        "flags": ["avx2"],
        "cores": 4,
        "cores_allowed": [0, 1, 2, 3],
    },
    "memory_bytes": 1 << 34,
    "gl": None,
    "packages": {"numpy": "2.0"},
}


def make_report(**changes: Any) -> dict[str, Any]:
    """What a run writes, with `changes`."""
    counts = {"requested": 5, "presented": 3, "lost": 0, "lost_by_cause": {}, "dropped": {"raster->infer:stale": 1}}
    run = {
        "frames": {**counts, "not_begun": 1},
        "frame_time_ms": {**TIMES, "ema20_min": 19.0, "ema20_max": 21.0, "jitter": 0.5},
        "latency_ms": TIMES,
        "fps": 50.0,
        "deadline_misses": 0,
        "stages": {"infer": {"unit": "dsp", "service_ms": TIMES, "wait_ms": TIMES}},
        "units": {"dsp": SHARE},
        "core_shares": [{"cores": [2, 3], "units": ["cpu", "gpu"], "cpu": 0.8, "busy": 0.75}],
        "efficiency": 0.91,
        "core_efficiency": 0.93,
        "machine_efficiency": 0.84,
        "bottleneck": "dsp",
        "bound": {
            "unit": {"name": "dsp", "share": 0.82, "share_low": 0.78, "share_high": 0.861},
            "stage": {"name": "infer", "share": 0.44, "share_low": None, "share_high": None},
        },
    }
    config = {
        "policy": "pipelined",
        "runtime": "ort",
        "units": {"dsp": {"cores": [2, 3], "threads": 2, "spin": True}},
        "scene": {"name": "test", "size": "256", "output": {"width": 640, "height": 480}},
    }
    return {
        "schema": 1,
        "clock": "host",
        "machine": MACHINE,
        "config": config,
        "plan": {"tensor_shapes": [[256, 256]]},
        "caps": {"how": "none"},
        **run,
        "duration_s": 1.0,
        "xrbench": {"real_time": None, "qoe": 1.0, "energy": None},
        "policy": "pipelined",
        "edge": "double",
        "idle_cores": "wait awake",
        "temperature_c": {"sensor": None},
        "pids": {"dsp": 7},
        "startup_ms": {"dsp": 1.0},
        "figures": {"infer": {"a_ms": 1.0}},
        "messages": [],
        "interrupted": False,
        "failure": None,
        "baseline": {"policy": "sequential", **run, "efficiency": None},
        "accuracy": {"someone": SHOWN},
        "sources": {},
        "video": None,
        "checksum": None,
        **changes,
    }


def make_metrics(**changes: Any) -> dict[str, Any]:
    """What the last record of a journal has, with `changes`."""
    return {key: value for key, value in make_report(**changes).items() if key in RunMetrics.model_fields}
