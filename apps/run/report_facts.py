"""Builds report.json from the result of a run, with the source of every figure and the command that made the report.

`report_of` is for a run of any pipeline. `avatar_report` adds the facts of a run of avatars, such as tensor sizes.

Rule: the longest matching key of `SOURCES` gives the source of a figure, and every figure matches a key. The number of
frames of each tensor size comes from the run. The image error of a tensor size comes from the avatars' validation.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from trilane.apps.run.report import SCHEMA, Report, Resolution, TensorSize, VerdictFacts
from trilane.apps.run.verdict_facts import verdict_of
from trilane.avatars.validation import SizeLoss
from trilane.machine import here
from trilane.pipeline.result import RunResult
from trilane.pipeline.run_metrics import Caps, PolicyMetrics, RunMetrics, Temperature
from trilane.stages.config import RunConfig
from trilane.units import ALL_WORK, COMPARED, COMPUTED, MEASURED

CHECKOUT: Final = Path(__file__).resolve().parents[2]
GIT_S: Final = 5.0
NO_CAP = "none: every unit works as much as its cores and threads allow"
#: Key of the report, as a dotted path -> source of all figures below this key.
SOURCES = {
    "frames": MEASURED,
    "duration_s": MEASURED,
    "frame_time_ms": MEASURED,
    "latency_ms": MEASURED,
    "fps": MEASURED,
    "deadline_misses": MEASURED,
    "xrbench": MEASURED,
    "xrbench.energy": COMPUTED,
    "stages": MEASURED,
    "bytes": MEASURED,
    "bytes.least": COMPUTED,
    "bytes.ratio": COMPARED,
    "units": MEASURED,
    "efficiency": MEASURED,
    "core_efficiency": MEASURED,
    "machine_efficiency": MEASURED,
    "bound": COMPUTED,
    "other_programs": MEASURED,
    "processor": MEASURED,
    "caps": COMPUTED,
    "temperature_c": COMPUTED,
    "temperature_c.sensor": MEASURED,
    "startup_ms": MEASURED,
    "figures": MEASURED,
    "baseline": MEASURED,
    "verdict": COMPUTED,
    "placement": COMPUTED,
    "placement.times": MEASURED,
    "resolution": MEASURED,
    "pace": COMPUTED,
    "pace.host_slower": MEASURED,
    "pace.late_frames": MEASURED,
    "pace.measured_ms": MEASURED,
    "pace.compared_share": MEASURED,
    "pace.ratio": COMPARED,
    "video": MEASURED,
    "check": MEASURED,
}


def report_of(
    result: RunResult,
    config: Mapping[str, Any],
    *,
    machine: Mapping[str, Any],
    baseline: RunResult | None = None,
    facts: Mapping[str, Any],
) -> Report:
    """Build the report of a run on the host clock. Raises ValueError, which names a wrong or unknown key.

    `result`: result of the run. `config`: block `config` of the report. `machine`: result of `machine_facts`.
    `baseline`: result of the `sequential` run of the same pipeline; None without such a run.
    `facts`: values of further keys of the report, by key: `video` and `checksum`, and any of the optional keys.
    """
    metrics = result.report
    document = {
        **metrics.as_json(),
        "schema": SCHEMA,
        "machine": machine,
        "config": config,
        "caps": metrics.caps or Caps(how=NO_CAP),
        "temperature_c": (metrics.temperature_c or Temperature()).model_copy(update={"sensor": here.sensor_c()}),
        "pids": result.pids,
        "startup_ms": result.startup_ms,
        "figures": result.metrics,
        "messages": result.messages,
        "interrupted": result.interrupted,
        "failure": result.failure and result.failure.message,
        "baseline": baseline and _compared(baseline.report),
        **facts,
    }
    report = Report.model_validate(document)
    verdict = VerdictFacts.model_validate(verdict_of(report).as_json())
    report = report.model_copy(update={"verdict": verdict})
    return report.model_copy(update={"sources": sources_of(report)})


def _compared(metrics: RunMetrics) -> PolicyMetrics:
    return PolicyMetrics.model_validate({key: getattr(metrics, key) for key in PolicyMetrics.model_fields})


def sources_of(report: Report) -> dict[str, str]:
    """Return the source of each figure in a report, by dotted key.

    The figures `least` and `ratio` of a stage's bytes have sources of their own, because they are not measured.
    """
    document = report.as_json()
    sources = {key: source for key, source in SOURCES.items() if _holds(document, key.split("."))}
    counting = [f"stages.{name}.bytes" for name, times in report.stages.items() if times.bytes]
    sources |= {f"{key}.{figure}": SOURCES[f"bytes.{figure}"] for key in counting for figure in ("least", "ratio")}
    return sources | {f"accuracy.{name}": facts["source"] for name, facts in report.accuracy.items()}


def _holds(document: Any, path: list[str]) -> bool:
    """Return whether `document` has a value other than None at `path`, a list of keys, the outermost first."""
    for key in path:
        if not isinstance(document, Mapping) or key not in document:
            return False
        document = document[key]
    return document is not None


def made_facts(command: Sequence[str], checkout: Path = CHECKOUT) -> dict[str, Any]:
    """Return the values of the fields of `trilane.apps.run.report.Made`, with the time of this call.

    Unknown values are None.

    `command`: words of the command line. `checkout`: folder that contains Trilane; it may be a git checkout.
    """
    from trilane.stages.machine_facts import package_version

    revision, modified = _revision(checkout)
    return {
        "at": here.now().isoformat(timespec="seconds"),
        "command": list(command),
        "trilane": package_version("trilane"),
        "revision": revision,
        "modified": modified,
    }


def _revision(checkout: Path) -> tuple[str | None, bool | None]:
    """Return (git revision of `checkout`, whether its tracked files were modified). An unknown value is None."""
    git = here.program("git")
    if git is None or not (checkout / ".git").exists():
        return None, None
    revision = _git(git, checkout, "rev-parse", "HEAD")
    changes = _git(git, checkout, "status", "--porcelain", "--untracked-files=no")
    return revision, None if revision is None or changes is None else bool(changes)


def _git(git: str, checkout: Path, *words: str) -> str | None:
    """Return the output of a git command in `checkout`; None if the command fails.

    `git`: path of the program. `words`: words of the command after `git`.
    """
    command = [git, "--no-optional-locks", "-C", str(checkout), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=GIT_S)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def avatar_report(
    result: RunResult,
    config: RunConfig,
    *,
    machine: Mapping[str, Any],
    baseline: RunResult | None,
    facts: Mapping[str, Any],
) -> Report:
    """Build the report of a run of avatars.

    `config`: configuration of the run. Other parameters and errors: see `report_of`. `facts` may also have
    `placement`, `resolution`, `pace`, `accuracy` and `check`.
    """
    facts = {"plan": {"tensor_shapes": config.buckets}, **facts}
    shown = config_facts(config, result.report.policy, result.report.edge)
    return report_of(result, shown, machine=machine, baseline=baseline, facts=facts)


def config_facts(config: RunConfig, policy: str, edge: str) -> dict[str, Any]:
    """Return the block `config` of the report of a run of avatars. `policy`: policy. `edge`: rule of the edges."""
    return {**config.model_dump(mode="json", exclude={"out_dir", "window", "kept"}), "policy": policy, "edge": edge}


def resolution_of(rungs: Mapping[int, int], switches: int, config: RunConfig, losses: Sequence[SizeLoss]) -> Resolution:
    """Return the sizes of a run's tensors, with the loss of PSNR in each.

    `rungs`: number of presented frames by rung; each rung has one tensor size. `switches`: number of presented frames
    whose rung differs from the previous frame's rung. `config`: configuration of the run. `losses`: loss of PSNR by
    tensor size, for each avatar of the scene.
    """
    sizes = tuple(
        TensorSize(
            work=work / ALL_WORK,
            most_pixels=budget.most_of(1),
            frames=rungs.get(rung, 0),
            psnr_loss_db=worst_loss(work, losses),
        )
        for rung, (work, budget) in enumerate(zip(config.works, config.tensor_budgets, strict=True))
    )
    sources = dict.fromkeys(loss.source for loss in losses)
    return Resolution(sizes=sizes, switches=switches, loss_source="; ".join(sources))


def worst_loss(work: int, losses: Sequence[SizeLoss]) -> float | None:
    """Return the largest loss of PSNR among avatars for one tensor size, in dB; None if an avatar's loss is unknown.

    `work`: number of the tensor's pixels, in thousandths of the number that the network was trained for.
    `losses`: loss of PSNR by tensor size, for each avatar.
    """
    found = [loss.at(work) for loss in losses]
    known = [db for db in found if db is not None]
    return max(known) if known and len(known) == len(found) else None


def resolution_note(resolution: Resolution) -> str:
    """Return a message on the number of frames with smaller tensors; "" if all frames had the largest tensor."""
    less = [size for size in resolution.sizes[1:] if size.frames]
    if not less:
        return ""
    total = sum(size.frames for size in resolution.sizes)
    parts = ", ".join(_said(size) for size in less)
    return (
        f"resolution: to be in time {sum(size.frames for size in less)} of {total} presented frames had smaller "
        f"tensors: {parts}; {resolution.switches} switches (error: {resolution.loss_source})"
    )


def _said(size: TensorSize) -> str:
    loss = f", {size.psnr_loss_db:.1f} dB worse" if size.psnr_loss_db is not None else ""
    return f"{size.frames} of at most {size.most_pixels} pixels an avatar{loss}"
