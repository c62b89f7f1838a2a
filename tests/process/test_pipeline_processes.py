"""The pipeline as processes: what a run presents, survives and leaves behind (which is nothing)."""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import pytest

from support.doubles import HANG, LOSING_FACTORY
from support.doubles import pipeline_of_doubles as doubles
from support.faults import unit_process
from trilane import machine
from trilane.apps.run.pace import Pace, compare
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.profile_files import load_runnable
from trilane.pipeline.controls import RunControls
from trilane.pipeline.description import Pipeline
from trilane.pipeline.fork_server import THREAD_LIMITS
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.events import Dispatch, JobDone, Pong, UnitDied
from trilane.scheduler.recording import replay
from trilane.signals import ENDING
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions

pytestmark = pytest.mark.usefixtures("nothing_left")
#: A unit that is silent for so long has stopped; a busy machine keeps one from its core for some hundredths of it.
HANG_NS = 1_500_000_000
PATIENCE_S = 60.0
Run = Callable[..., RunResult]


@pytest.fixture
def run(starter: UnitStarter) -> Run:
    """`run_pipeline` with a fork server that is up."""
    return partial(run_pipeline, starter=starter)


class When:
    """Does `action` once the run has presented `frames`."""

    def __init__(self, frames: int, action: Callable[[], object]) -> None:
        self._frames, self._action, self._done = frames, action, False

    def __call__(self, presented: int, _requested: int) -> None:
        if presented >= self._frames and not self._done:
            self._done = True
            self._action()


def by_cause(counts: Mapping[Any, int]) -> dict[str, int]:
    return {str(cause): count for cause, count in counts.items()}


def with_factory(pipeline: Pipeline, name: str, factory: str) -> Pipeline:
    """`pipeline` with another factory of stage `name`."""
    stages = [s.model_copy(update={"factory": factory}) if s.name == name else s for s in pipeline.stages]
    return pipeline.model_copy(update={"stages": tuple(stages)})


def in_hand(result: RunResult, unit: str) -> set[int]:
    """The frames whose jobs the unit had been handed, and had not done, when it died."""
    held: dict[int, int] = {}
    for _, events, actions in result.recording.steps:
        if any(isinstance(event, UnitDied) and event.unit == unit for event in events):
            break
        for event in events:
            if isinstance(event, JobDone):
                held.pop(event.job, None)
        held |= {act.job.id: act.job.frame for act in actions if isinstance(act, Dispatch) and act.job.unit == unit}
    return set(held.values())


def check_accounts(result: RunResult) -> None:
    counted = result.presented + sum(result.lost.values()) + sum(result.dropped.values())
    assert counted == result.requested
    for unit in result.report.units.values():
        assert unit.busy + sum(unit.idle.as_json().values()) == pytest.approx(1)
    assert not list(replay(result.recording))


@pytest.mark.parametrize("policy", ["sequential", "pipelined"])
@pytest.mark.parametrize("edge", ["single", "double"])
def test_every_frame_is_presented_in_order(run: Run, tmp_path: Path, policy: str, edge: str) -> None:
    log = tmp_path / "presented.txt"
    result = run(doubles(log).with_rule(edge), 40, policy=policy)
    assert result.failure is None
    assert (result.presented, dict(result.lost), dict(result.dropped)) == (40, {}, {})
    assert log.read_text().split() == [str(frame) for frame in range(40)]
    assert len(set(result.pids.values())) == 3
    assert result.report.clock == "host"
    assert 0 < (result.report.efficiency or 0) <= 1
    check_accounts(result)


@pytest.mark.parametrize(("policy", "edge"), [("latest", "triple"), ("deadline", "double"), ("latest", "orphan")])
def test_a_paced_run_drops_what_it_cannot_do_and_counts_it(run: Run, policy: str, edge: str) -> None:
    """The DSP can do 25 of the 40 frames in the second in which they come, and two in hand."""
    result = run(doubles(infer=40).with_rule(edge), 40, policy=policy, pace_fps=40)
    assert sum(result.dropped.values()) >= 13
    assert result.presented >= 1  # how many more, the load of the machine decides
    assert 0 < (result.report.efficiency or 0) <= 1
    check_accounts(result)


def test_a_run_at_a_pace_has_the_frame_time_of_virtual_time(run: Run) -> None:
    """Jobs of a millisecond, held for 5 to 100. The shortest interval: another program may hold some frames up.

    It would be 125 ms if raster did not go on beside infer, and 150 ms if composite did not.
    """
    stage_ns = {"pose": 5, "raster": 25, "infer": 100, "composite": 50, "present": 5}
    stage_ns = {stage: ms * 1_000_000 for stage, ms in stage_ns.items()}
    result = run(doubles(pace_ns=stage_ns), 10)
    found = compare(Pace("chip", "any", 1.0, stage_ns), "pipelined", 10, result.jobs)
    assert result.presented == 10
    assert found.virtual_ms == 100
    infer = [job.begin_ns for job in result.jobs if job.stage == "infer"]
    assert 100e6 <= min(after - before for before, after in pairwise(infer)) < 125e6
    assert result.report.frame_time_ms.mean >= 0.95 * 100
    assert min(job.end_ns - job.begin_ns for job in result.jobs if job.stage == "infer") >= stage_ns["infer"]


class Capped:
    """A governor that holds nobody and knows the power: 3 W."""

    due_ns, is_prompt, power_w = 1 << 61, False, 3.0

    def begin(self, now_ns: int) -> list[Any]:  # noqa: ARG002
        return []

    def report(self) -> dict[str, Any]:
        return {"temperature_c": {"sensor": None}}


def test_a_report_says_what_was_run_and_where(run: Run) -> None:
    """Frames of 5 ms and more: each of the 11 frame times misses a target of 1 ms, and none one of 100 s."""
    pipeline, cores = doubles(infer=5), set(machine.here.cores())
    result = run(pipeline, 12, fps=1000.0, governor=Capped())
    report = result.report
    assert set(machine.here.cores()) == cores
    assert (report.policy, report.edge, report.clock, report.deadline_misses) == ("pipelined", "double", "host", 11)
    assert report.idle_cores == "sleep: the performance profile asks for no haste"
    assert report.xrbench.energy == pytest.approx(1 - 3000 / report.fps / 1500)
    assert (report.xrbench.qoe, report.frames.requested, result.requested) == (1, 12, 12)
    for unit, row in report.units.items():
        settings = pipeline.units[unit]
        assert (row.pid, row.cores, row.threads, row.spin) == (
            result.pids[unit], settings.cores, settings.threads, settings.spin
        )  # fmt: skip
    assert set(result.startup_ms) == set(report.units) and min(result.startup_ms.values()) > 0
    assert {stage: means["frame"] for stage, means in result.metrics.items()} == dict.fromkeys(report.stages, 5.5)
    assert len(result.jobs) == 60 and (result.interrupted, result.messages) == (False, ())
    assert all(
        job.ready_ns <= job.dispatch_ns <= job.begin_ns < job.end_ns for job in result.jobs if job.stage != "pose"
    )
    slow = run(doubles(), 5, fps=0.01)
    assert (slow.report.deadline_misses, slow.report.xrbench.energy) == (0, None)


@pytest.mark.parametrize(("unit", "slowest", "most"), [("cpu", "pose", 2), ("gpu", "raster", 1), ("dsp", "infer", 1)])
def test_a_unit_that_is_killed_again_is_restarted_each_time_and_the_run_goes_on(
    run: Run, unit: str, slowest: str, most: int
) -> None:
    """The unit that is killed is the slowest, so it holds two jobs. The first is lost; the second is done again, but
    for a pose, which no edge keeps."""
    victims = []

    def kill() -> None:
        victims.append(unit_process(unit).pid)
        os.kill(victims[-1], signal.SIGKILL)

    kills = [When(frames, kill) for frames in (5, 20)]
    result = run(doubles(**{slowest: 30}), 40, on_progress=lambda *counts: [when(*counts) for when in kills])
    assert result.failure is None
    assert set(map(str, result.lost)) == {f"died:{unit}"}
    assert 2 <= sum(result.lost.values()) <= 2 * most
    assert result.report.units[unit].restarts == len(victims) == 2
    assert result.pids[unit] not in victims
    assert any(unit in message for message in result.messages)
    assert by_cause(result.dropped) == {}
    check_accounts(result)


def test_a_unit_that_is_stopped_for_less_than_it_may_be_silent_goes_on_and_nothing_is_lost(run: Run) -> None:
    def stop() -> None:
        process = unit_process("gpu")
        process.suspend()
        threading.Timer(0.5, process.resume).start()

    result = run(doubles(), 60, on_progress=When(10, stop))
    assert (result.presented, by_cause(result.lost), result.report.units["gpu"].restarts) == (60, {}, 0)
    ends = sorted(job.end_ns for job in result.jobs if job.unit == "gpu")
    assert max(after - before for before, after in pairwise(ends)) > 400_000_000


def fork_server() -> psutil.Process:
    """The one that began last. A process that has just begun has no command line yet, even after Popen has returned."""
    end = time.monotonic() + PATIENCE_S
    while not all((lines := {child: command_line(child) for child in psutil.Process().children()}).values()):
        assert time.monotonic() < end
        time.sleep(0.001)
    servers = [child for child, line in lines.items() if "trilane.pipeline.fork_server" in line]
    return max(servers, key=psutil.Process.create_time)


def command_line(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:  # a zombie too
        return ["ended"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("is_replaced", [True, False])
def test_units_outlive_their_fork_server_and_come_from_a_fresh_one(number: signal.Signals, is_replaced: bool) -> None:
    """A unit is killed when the fork server was found gone or stopped, or before anybody has looked."""
    units: list[psutil.Process] = []
    presented: list[int] = [0]
    killed_at: list[int] = []
    controls = RunControls()

    def kill() -> None:
        units[0].kill()
        killed_at.append(presented[0])

    def hurt() -> None:
        units.append(unit_process("dsp"))  # which is nobody's child any more when its fork server has ended
        fork_server().send_signal(number)
        if not is_replaced:
            kill()

    hurt_once = When(5, hurt)

    def shown(count: int, requested: int) -> None:
        presented[0] = count
        hurt_once(count, requested)
        if killed_at and count >= killed_at[0] + 10:  # at most a few were past the unit: it is back
            controls.stop()

    def heard(text: str) -> None:
        if is_replaced and "fork server" in text:
            kill()

    result = run_pipeline(doubles(infer=30), 100_000, controls=controls, on_progress=shown, on_message=heard)
    assert result.failure is None
    assert set(map(str, result.lost)) == {"died:dsp"}
    assert 1 <= sum(result.lost.values()) <= len(in_hand(result, "dsp")) <= 2
    assert {unit: row.restarts for unit, row in result.report.units.items()} == {"cpu": 0, "gpu": 0, "dsp": 1}
    how = "was killed by signal 9" if number == signal.SIGKILL else "was stopped"
    replaced = f"the fork server, which every unit comes from, {how} and is replaced"
    assert not is_replaced or result.messages.count(replaced) == 1
    check_accounts(result)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_call_is_made_by_a_fresh_fork_server(number: signal.Signals) -> None:
    with UnitStarter() as starter:
        call = starter.call("os:getcwd")
        fork_server().send_signal(number)
        assert call.result() == str(Path.cwd())


def test_a_fork_server_has_one_thread_a_library_and_leaves_to_its_parent_what_ends_a_run() -> None:
    with UnitStarter() as starter:
        assert {fork_server().environ()[name] for name in THREAD_LIMITS} == {"1"}
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            fork_server().send_signal(number)
        assert starter.call("os:getcwd").result() == str(Path.cwd())
        assert starter.trouble() == ""
        assert starter.call("os:abort").result() is None


def test_closing_does_not_wait_for_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilane.pipeline.unit_starter.CLOSE_S", PATIENCE_S)
    begin_s = time.monotonic()
    with UnitStarter() as starter:
        starter.call("signal:pause").close()
    assert time.monotonic() - begin_s < PATIENCE_S


def test_a_caller_with_more_than_1024_open_files_can_run_a_pipeline() -> None:
    """select(2) takes no descriptor above 1023."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    held = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
    try:
        assert run_pipeline(doubles(), 5).presented == 5
    finally:
        for fd in held:
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"fps": 0.0}, {"fps": float("nan")}, {"hang_ns": 0}, {"pace_fps": -1.0}]
)
def test_settings_that_cannot_be_are_refused_before_a_unit_starts(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match=next(iter(wrong))):
        run_pipeline(doubles(), **{"frames": 5, **wrong})


def test_a_stopped_unit_is_found_by_its_deadline(run: Run) -> None:
    stop = When(10, lambda: unit_process("dsp").suspend())
    result = run(doubles(infer=10), 40, hang_ns=HANG_NS, on_progress=stop)
    assert set(map(str, result.lost)) == {"hung:dsp"}
    assert any("did not answer in time" in message for message in result.messages)
    check_accounts(result)


def test_idle_units_are_asked_whether_they_live(run: Run) -> None:
    """The CPU waits longer for its next job than a unit may be silent."""
    pipeline = doubles(raster="600@1", infer="600@1", composite="600@1")
    result = run(pipeline, 2, policy="sequential", hang_ns=HANG_NS)
    beats = [event for _, events, _ in result.recording.steps for event in events if isinstance(event, Pong)]
    assert result.presented == 2
    assert not any(unit.restarts for unit in result.report.units.values())
    assert any(beat.unit == "cpu" for beat in beats)


def test_a_job_that_never_ends_ends_the_run_after_some_restarts(run: Run) -> None:
    result = run(doubles(raster=HANG), 8, hang_ns=HANG_NS)
    assert by_cause(result.lost) == {"hung:gpu": 1}
    assert result.presented == 7
    check_accounts(result)


def test_a_cap_holds_every_unit_and_says_so(run: Run) -> None:
    """Half of the time at most, whatever the jobs ask for; the recording with the cap's events replays."""
    pipeline = doubles(infer=20)
    free = run(pipeline, 20)
    capped = run(pipeline, 40, governor=Governor(load_runnable("host"), "power_saver"))
    check_accounts(capped)
    assert free.report.units["dsp"].idle.throttled == 0
    assert capped.report.fps < 0.7 * 1000 / 20
    assert capped.report.units["dsp"].idle.throttled > 0.2
    assert capped.report.caps is not None
    assert capped.report.caps.performance_profile == "power_saver"
    assert capped.report.caps.units["dsp"].duty < 0.5


def test_a_lost_context_costs_a_restart_and_a_frame(run: Run, tmp_path: Path, drawable_bundle: Path) -> None:
    checked = configure(RunOptions(avatar=str(drawable_bundle), frames=12, size="64", runtime="ort"), tmp_path)
    losing = with_factory(avatar_pipeline(checked.config, checked.assets), "raster", LOSING_FACTORY)
    result = run(losing, 12, assets=checked.assets)
    assert result.failure is None
    assert by_cause(result.lost) == {"died:gpu": 1}
    assert result.report.units["gpu"].restarts == 1
    assert any("context was lost" in message for message in result.messages)
    check_accounts(result)


def test_a_stage_that_raises_ends_the_run_with_its_sentence(run: Run) -> None:
    result = run(doubles(infer="raise"), 200)
    assert result.failure is not None
    assert result.failure.exit_code == 2
    assert result.failure.message == "mock.npz: found nothing, expected something"
    assert result.presented < 50
    assert by_cause(result.lost) == {"failed:infer": 1}


def test_a_stage_that_cannot_be_built_is_the_callers_error(run: Run) -> None:
    with pytest.raises(TrilaneError, match="expected a network; train one") as caught:
        run(doubles(raster="badbuild"), 5)
    assert caught.value.exit_code == 2


def test_a_unit_that_dies_while_it_starts_is_an_error_with_its_last_words(run: Run) -> None:
    pipeline = with_factory(doubles(), "infer", "antigravity_none:build")
    with pytest.raises(TrilaneError, match="antigravity_none"):
        run(pipeline, 5)


@pytest.mark.parametrize("number", ENDING)
def test_an_interrupt_finishes_what_is_in_flight(run: Run, number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # the test may itself run under nohup
    try:
        result = run(doubles(infer=5), 2000, on_progress=When(10, lambda: os.kill(os.getpid(), number)))
    finally:
        signal.signal(number, before)
    assert result.interrupted
    assert result.failure is None
    assert 10 <= result.presented < 100
    assert not result.lost
    assert result.report.frames.not_begun == 2000 - result.presented


def test_a_second_interrupt_ends_at_once(run: Run) -> None:
    """The second comes once the first was heard; the job in hand would never end, nor its unit be given up."""

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    def again(text: str) -> None:
        if text.startswith("interrupted"):
            interrupt()

    hang_ns = 3_600_000_000_000
    result = run(doubles(raster=HANG), 20, hang_ns=hang_ns, on_progress=When(2, interrupt), on_message=again)
    assert result.interrupted
    aborted = by_cause(result.lost)["aborted"]
    assert aborted >= 1
    assert result.report.frames.not_begun == 20 - result.presented - aborted
    assert not list(replay(result.recording))


SCRIPT = """
import sys
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.events import SchedulerStalled
from support.doubles import pipeline_of_doubles

result = run_pipeline(pipeline_of_doubles(infer=int(sys.argv[3])), int(sys.argv[1]),
                      hang_ns=int(float(sys.argv[2]) * 1e9), on_progress=lambda done, _: print(done, flush=True))
happened = [event for _, events, _ in result.recording.steps for event in events]
print("stalled", max((event.ns for event in happened if isinstance(event, SchedulerStalled)), default=0))
print(f"over: {result.presented} presented, lost {dict(result.lost)}, {result.messages}", flush=True)
"""


def script(frames: int, hang_s: float, infer_ms: int = 1) -> list[str]:
    return [sys.executable, "-c", SCRIPT, str(frames), str(hang_s), str(infer_ms)]


@contextmanager
def presenting(words: list[str], frames: int) -> Iterator[subprocess.Popen[str]]:
    """Context manager: a run in a process group of its own that has presented so many frames."""
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, process_group=0) as parent:
        assert parent.stdout is not None
        try:
            while int(parent.stdout.readline()) < frames:
                pass
            yield parent
        finally:
            parent.kill()


def all_end(processes: list[psutil.Process]) -> bool:
    """A zombie has ended; who takes leave of it may be slow."""
    _, alive = psutil.wait_procs(processes, timeout=PATIENCE_S)
    return all(process.status() == psutil.STATUS_ZOMBIE for process in alive)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_nothing_outlives_the_parent(nothing_left: Path, number: signal.Signals) -> None:
    with presenting(script(100_000, 10), 20) as parent:
        children = psutil.Process(parent.pid).children(recursive=True)
        assert len(children) == 4  # the fork server and three units
        assert not list(nothing_left.glob("trilane-*"))
        os.kill(parent.pid, number)
        parent.communicate(timeout=PATIENCE_S)
    assert all_end(children)


def test_units_without_their_fork_server_do_not_outlive_the_parent() -> None:
    with presenting(script(100_000, 10), 20) as parent:
        children = psutil.Process(parent.pid).children(recursive=True)
        os.kill(parent.pid, signal.SIGSTOP)  # so that it replaces nothing
        next(child for child in children if "trilane.pipeline.fork_server" in child.cmdline()).kill()
        units = [child for child in children if child.name().startswith("trilane-")]
        assert len(units) == 3
        parent.kill()
    assert all_end(units)


STOPPED_S = 1.8


def test_a_scheduler_that_was_stopped_blames_nobody() -> None:
    """Not the units that waited for it longer than they may be silent, with a job done or with nothing to do."""
    with presenting(script(60, STOPPED_S - 0.5, infer_ms=10), 10) as parent:
        os.kill(parent.pid, signal.SIGSTOP)
        time.sleep(STOPPED_S)  # the time itself is what is tried
        os.kill(parent.pid, signal.SIGCONT)
        said = parent.communicate(timeout=PATIENCE_S)[0].splitlines()
    assert parent.returncode == 0
    assert int(said[-2].removeprefix("stalled")) >= STOPPED_S * 1e9
    stopped = r"the scheduler itself was stopped by a signal for about (.*) s, at frame (.*)"
    told = rf"over: 60 presented, lost \{{\}}, \('{stopped}',\)"
    matched = re.fullmatch(told, said[-1])
    assert matched is not None
    assert float(matched[1]) >= STOPPED_S
    assert 10 <= int(matched[2]) < 60  # 10 were presented, and those in flight wait


def test_units_that_cannot_be_started_leave_nothing(nothing_left: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`nothing_left` looks for open files and processes."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    for part in ("subprocess.Popen", "os.memfd_create", "trilane.pipeline.unit_processes.job_pipe_pair"):
        with monkeypatch.context() as patched, pytest.raises(OSError, match="Cannot allocate"):
            patched.setattr(part, refuse)
            run_pipeline(doubles(), 3)
        assert not list(nothing_left.glob("trilane-*"))


def test_a_run_that_may_open_too_few_files_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("resource.getrlimit", lambda _: (40, 4096))
    with pytest.raises(TrilaneError, match="found a limit of 40, expected at least 96"):
        run_pipeline(doubles(), 3)


def test_an_idle_unit_that_does_not_answer_is_restarted(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """The DSP has no job while pose and raster work, for twice 1.2 s, and so loses none."""
    monkeypatch.setattr("trilane.pipeline.realtime_clock.PING_NS", 50_000_000)
    stop = When(1, lambda: unit_process("dsp").suspend())
    pipeline = doubles(pose="1200@1", raster="1200@1")
    result = run(pipeline, 3, policy="sequential", hang_ns=HANG_NS, on_progress=stop)
    assert result.report.units["dsp"].restarts == 1
    assert any("dsp did not answer in time" in message for message in result.messages)
    assert result.presented == 3 and not result.lost


def test_a_parent_killed_while_it_starts_leaves_what_the_next_run_removes(nothing_left: Path) -> None:
    parent = subprocess.Popen(script(100_000, 10), stdout=subprocess.DEVNULL)
    while not list(nothing_left.glob("trilane-*/*")):
        time.sleep(0.001)
    children = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.wait()
    assert all_end(children)
    run_pipeline(doubles(), 3)
    assert not list(nothing_left.glob("trilane-*"))
