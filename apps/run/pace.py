"""A run at the pace of a chip: how long each job takes, and how the run compares with the same run in virtual time.

Rule: the chip's times come from its hardware profile, and the order of jobs comes from the scheduler. The report counts
the jobs for which this machine needed longer than the chip.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from trilane.apps.run.report import PaceComparison
from trilane.avatars.bundle import load_bundle
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, application_graph, stage_times_ms
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import corners_of
from trilane.scheduler.events import Settings
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.policy import run_settings
from trilane.scheduler.virtual import simulate
from trilane.stages.avatar_assets import painting
from trilane.stages.config import RunConfig
from trilane.transport.slots import DEFAULT_EDGE
from trilane.units import BEFORE_INFER, BYPASS, SUSTAINED, TARGET_FPS

MAX_SLOW_MOTION = 1000.0
#: A job counts as late if it ends later than this after its time: waking up takes this long on a quiet machine.
SLACK_NS = 200_000
#: A late frame may change the times of this many frames, itself included: the frames in flight and one more.
WAKE_FRAMES = 8


@dataclass(frozen=True)
class Pace:
    """The pace of a chip.

    `profile`: hardware profile of the chip, by name. `performance_profile`: performance profile of the chip.
    `slow_motion`: factor by which the run is slower than the chip.
    `stage_ns`: time in ns to which a job is stretched, by stage. It includes the slow motion.
    """

    profile: str
    performance_profile: str
    slow_motion: float
    stage_ns: Mapping[str, int]


def pace_of(config: RunConfig, profile: str, slow_motion: float = 1.0) -> Pace:
    """Return the pace of a chip for the run that `config` describes.

    The times are for the largest shape in `config.buckets`, with all avatars in view, under the performance profile
    SUSTAINED. Each network has a tensor of this shape.
    `profile`: hardware profile of the chip, by name or TOML file.
    `slow_motion`: factor on all times, above 0 and at most MAX_SLOW_MOTION.
    Raises BadInputError for a profile that describes no chip, for a factor out of range, and for a bundle that cannot
    be read.
    """
    if not 0 < slow_motion <= MAX_SLOW_MOTION:
        raise BadInputError("--slow-motion", f"{slow_motion:g}", f"above 0, at most {MAX_SLOW_MOTION:g}")
    chip = load_runnable(profile)
    shape = max(config.buckets, key=lambda shape: shape[0] * shape[1])
    folders = {config.network_of(number): folder for number, folder in enumerate(config.avatar_dirs)}
    files = [load_bundle(folder).read_network() for folder in folders.values()]
    network = painting(files, shape, {"avatar": config.avatar_dirs[0].name})
    plan = Plan(network, "dsp", avatars=len(config.avatar_dirs))
    times = stage_times_ms(chip, plan, corners_of(chip, SUSTAINED))
    held = {stage: round(ms * slow_motion * 1e6) for (stage, _), ms in times.items()}
    return Pace(chip.name, SUSTAINED, slow_motion, held)


def release_fps(pace: Pace, scene_fps: float) -> float:
    """Return the rate at which a paced policy releases frames, in frames a second.

    The rate is `scene_fps`, the rate of the scene, divided by the factor of the slow motion.
    """
    return scene_fps / pace.slow_motion


def compare(
    pace: Pace,
    policy: str,
    frames: int,
    jobs: Sequence[JobRecord],
    *,
    edge: str = DEFAULT_EDGE,
    fps: float = TARGET_FPS,
) -> PaceComparison:
    """Compare a run at a chip's pace with the same run in virtual time.

    `pace`, `policy`, `frames`, `edge`: pace, policy, number of frames and rule of the edges of the run. `jobs`: jobs of
    the run. `fps`: rate of the scene, in frames a second.
    """
    late = [job for job in jobs if job.end_ns - job.begin_ns > pace.stage_ns[job.stage] + SLACK_NS]
    late_frames = sorted({job.frame for job in late})
    settings = run_settings(policy, frames, round(1e9 / release_fps(pace, fps)))
    virtual = _virtual_ms(pace, settings, edge, _skipping(jobs))
    measured = _median_ms(jobs, late_frames)
    return PaceComparison(
        profile=pace.profile,
        performance_profile=pace.performance_profile,
        slow_motion=pace.slow_motion,
        stage_ms={stage: ns / 1e6 for stage, ns in pace.stage_ns.items()},
        host_slower=dict(Counter(job.stage for job in late)),
        late_frames=tuple(late_frames),
        virtual_ms=virtual,
        measured_ms=measured,
        compared_share=_share(jobs, late_frames),
        ratio=None if measured is None or virtual is None else measured / virtual,
    )


def _skipping(jobs: Sequence[JobRecord]) -> set[int]:
    """Return the numbers of the frames that took the pipeline's bypass. `jobs`: all jobs of the run."""
    ends, between = ({job.frame for job in jobs if job.stage == stage} for stage in (BYPASS[1], BEFORE_INFER[-1][0]))
    return ends - between


def _virtual_ms(pace: Pace, settings: Settings, edge: str, skipping: Set[int]) -> float | None:
    """Return the median time between presented frames in virtual time, ms; None for fewer than two frames.

    `pace`: pace of all jobs. `settings`: settings of the scheduler. `edge`: rule of all edges. `skipping`: numbers of
    the frames that take the bypass.
    """
    graph = replace(application_graph(edge), bypass=BYPASS)
    result = simulate(
        graph,
        settings,
        lambda stage, *_: pace.stage_ns[stage],
        skips=lambda frame, _fresh: frame in skipping,
        keep=True,
    )
    return _median_ms(result.jobs)


def _presented(jobs: Sequence[JobRecord]) -> tuple[list[int], list[int]]:
    """Return (numbers, times): the presented frames in the order of presentation, and when each was presented, ns."""
    ends = sorted((job.end_ns, job.frame) for job in jobs if job.stage == "present")
    return [frame for _, frame in ends], [end for end, _ in ends]


def _in_time(jobs: Sequence[JobRecord], late_frames: Sequence[int]) -> list[tuple[int, int]]:
    """Return (frame number, ns since the previous presented frame) for each presented frame that is not disturbed.

    A late frame disturbs the frame before it and the WAKE_FRAMES frames from itself on. `jobs`: all jobs of the run.
    `late_frames`: numbers of the frames with a job that took too long.
    """
    frames, ends = _presented(jobs)
    disturbed = {near for frame in late_frames for near in range(frame - 1, frame + WAKE_FRAMES)}
    pairs = zip(frames[1:], np.diff(ends).tolist(), strict=True)
    return [(frame, interval) for frame, interval in pairs if frame not in disturbed]


def _median_ms(jobs: Sequence[JobRecord], late_frames: Sequence[int] = ()) -> float | None:
    """Return the median of the times that `_in_time` returns, in ms; None if no frame is left."""
    kept = _in_time(jobs, late_frames)
    return float(np.median([interval for _, interval in kept])) / 1e6 if kept else None


def _share(jobs: Sequence[JobRecord], late_frames: Sequence[int]) -> float:
    return len(_in_time(jobs, late_frames)) / max(1, len(_presented(jobs)[0]) - 1)
