"""Where a training computes: the CPU, or a GPU that PyTorch can use.

Rule: a device that was asked for by name is used, or its absence is said; only `auto` chooses.
"""

from __future__ import annotations

import psutil
import torch

from trilane.errors import MissingPartError, package_line

MB = 1e6


def chosen_device(asked: str) -> torch.device:
    """`asked`: "auto", "cpu" or "cuda". Raises MissingPartError where there is no such GPU."""
    found = torch.cuda.is_available()
    if asked == "cuda" and not found:
        what = "device cuda: this PyTorch finds no NVIDIA GPU (device auto or cpu trains on the CPU)"
        raise MissingPartError(what, f"{package_line('torch')}, with NVIDIA's driver")
    return torch.device("cuda" if found and asked != "cpu" else "cpu")


def device_words(device: torch.device, threads: int) -> str:
    """What `device` is, as part of a sentence. `threads`: of PyTorch on the CPU."""
    if device.type == "cuda":
        return f"the GPU {torch.cuda.get_device_name(device)}"
    return f"{threads} {'thread' if threads == 1 else 'threads'} of the CPU"


def memory_words(device: torch.device) -> str:
    """What this process has of memory now, and of a GPU's the most that it had."""
    of_cpu = f"{psutil.Process().memory_info().rss / MB:.0f} MB of memory"
    if device.type != "cuda":
        return of_cpu
    return f"{of_cpu}, {torch.cuda.max_memory_allocated(device) / MB:.0f} MB of the GPU's"
