"""`trilane explain RUN` and the table of jobs: figures by hand, what is printed of them, and what is refused."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from support.run_folders import locked, write_run
from trilane.apps.explain.explained_run import (
    COLUMNS,
    ExplainedRun,
    JoinInput,
    Joins,
    _cores_allowed,
    explain_frame,
    explain_run,
    join_text,
    open_journal,
    write_jobs,
)
from trilane.apps.explain.reasons import MOST_SAMPLES, BudgetRow, EvenSample, ShownFrame, advice, notes
from trilane.apps.watch.followed_run import CUT_OFF
from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.critical_path import WORK, Budget, Paths
from trilane.pipeline.journal import NAME, Accounted, Begun, JournalWriter, Record, Said, Stepped, Worked, journal_of
from trilane.pipeline.timeline import ExplainedJob, Presented, Timeline
from trilane.pipeline.unit_history import JOIN, IdleSlice
from trilane.scheduler.events import Graph, Input, Settings, StageSpec, UnitDied
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import Simulation, simulate

MS = 1_000_000
STAGE_MS = {"pose": 1, "raster": 2, "infer": 4, "composite": 2, "present": 1}
CORES = {"cpu": (0,), "gpu": (1,), "dsp": (0,)}
Command = Callable[..., tuple[str, str]]


def simulated(slow: dict[tuple[str, int], int], settings: Settings | None = None, **driver: Any) -> Simulation:
    """A run of 40 frames, whose jobs in `slow` (stage, frame) take so many ms."""

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return slow.get((stage, frame), STAGE_MS[stage]) * MS

    return simulate(application_graph(), settings or Settings(40), service, keep=True, **driver)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A composite of 20 ms, a killed GPU unit, and poses that lack their core for 0.25 ms while infer has it."""
    run = simulated({("composite", 20): 20}, faults=[(125 * MS, "gpu")], restart_ns=50 * MS)
    jobs = [job._replace(preempted_ns=MS // 4) if job.stage == "pose" else job for job in run.jobs]
    return write_run(tmp_path / "run", run, jobs, cores=CORES, figures={"pose": {"visible": 1.0}, "infer": {"b": 2.5}})


def test_the_slowest_frames_and_why(folder: Path) -> None:
    found = explain_run(folder, 2).as_json()
    first, second = found["slowest"]
    assert found["usual"]["frame_ms"] == 4.0
    assert first["frame_ms"] > 50
    assert first["why"][0]["text"] == "gpu was restarted"
    assert first["why"][0]["longer_ms"] == pytest.approx(50, abs=3)
    assert second["frame"] == 20
    assert (second["frame_ms"], second["longer_ms"]) == (22.0, 18.0)
    assert second["why"] == [
        {
            "cause": "work",
            "stage": "composite",
            "longer_ms": 18.0,
            "text": "composite was slow: 20.0 ms, median 2.0",
        }
    ]
    assert found["usual"]["service_ms"] == STAGE_MS


def test_one_frame_by_its_jobs_or_by_why_it_left(folder: Path) -> None:
    found = explain_frame(folder, 20)
    assert (found.outcome, found.cause) == ("presented", None)
    took = {row.stage: row.took_ms for row in found.jobs}
    assert took == {**STAGE_MS, "composite": 20.0}
    last = found.jobs[-1]
    assert found.after_ms == pytest.approx(last.begin_ms + last.took_ms)
    assert all(row.wait_ms == pytest.approx(sum(row.causes_ms.values())) for row in found.jobs)
    outcomes = [explain_frame(folder, number).outcome for number in range(40)]
    assert (outcomes.count("presented"), outcomes.count("lost")) == (39, 1)
    assert explain_frame(folder, outcomes.index("lost")).cause == "died:gpu"
    with pytest.raises(BadInputError, match="40, expected a frame that began, of 0 to 39"):
        explain_frame(folder, 40)


def test_a_frame_that_a_newer_one_replaced(tmp_path: Path) -> None:
    run = simulated({}, Settings(40, policy="latest", period_ns=2 * MS, in_flight=2))
    found = explain_run(write_run(tmp_path / "run", run, run.jobs, cores=CORES)).as_json()
    each = [explain_frame(tmp_path / "run", number) for number in range(40)]
    counts = {cause: sum(one.cause == cause for one in each) for cause in found["left"]["dropped"]}
    assert counts == found["left"]["dropped"]
    assert sum(one.outcome == "presented" for one in each) == found["frames"] == run.report["frames"]["presented"]


def test_the_budget_sums_to_the_frame_time_and_names_shared_cores(folder: Path) -> None:
    found = explain_run(folder).as_json()
    assert sum(row["ms"] for row in found["budget"]) == pytest.approx(found["frame_ms"])
    assert sum(row["share"] for row in found["budget"]) == pytest.approx(1)
    assert found["frames"] == 39  # one was lost with the unit
    (row,) = found["shared_cores"]
    assert (row["stage"], row["cores"], row["shared"]) == ("pose", [0], {"infer": [0]})
    assert (row["service_ms"], row["preempted_ms"]) == (1.0, 0.25)
    assert row["taken_ms"]["infer"] + row["others_ms"] == pytest.approx(0.25)
    assert row["taken_ms"]["infer"] > 0.2  # infer nearly always works while a pose does


def test_a_frame_that_skips_or_has_another_rung_says_so(tmp_path: Path) -> None:
    """Frames 0 to 9 skip raster and infer; a full frame after them takes all stages."""
    graph = replace(application_graph(), bypass=("pose", "composite"))
    settings = Settings(20, "sequential")

    def skips(frame: int, fresh: bool) -> bool:
        return 0 < frame < 10 and not fresh

    run = simulate(graph, settings, lambda stage, *_: STAGE_MS[stage] * MS, skips=skips, keep=True)
    found = explain_run(write_run(tmp_path / "run", run), 40).as_json()
    rows = {row["frame"]: row for row in found["slowest"]}
    assert rows[10]["notes"] == ["the frame before took the bypass, it did not"]
    assert rows[1]["notes"] == ["it took the bypass"]
    assert rows[10]["frame_ms"] == 10.0
    assert rows[1]["frame_ms"] == 4.0


def test_what_was_unlike_the_frame_before_is_noted() -> None:
    now = Presented(7, 20, 100, 50, 70, skips=True, rung=2)
    before = Presented(3, 10, 50, None, 40, skips=False, rung=0)
    shown = ShownFrame(now, before, 50, {}, {})
    assert notes(shown) == [
        "frames 4 to 6 before it were dropped or lost",
        "its work changed from rung 0 to 2",
        "it took the bypass",
    ]
    alike = shown._replace(now=now._replace(skips=False, rung=0), before=before._replace(frame=5))
    assert notes(alike) == ["frame 6 before it was dropped or lost"]


def test_dropped_frames_and_late_input_are_named(tmp_path: Path) -> None:
    """A frame every 10 ms; infer of frame 5 takes 200 ms, so that frames are dropped behind it."""
    settings = Settings(40, "latest", period_ns=10 * MS, deadline_ns=30 * MS)
    found = explain_run(write_run(tmp_path / "run", simulated({("infer", 5): 200}, settings)), 40).as_json()
    assert any("before it were dropped or lost" in note for row in found["slowest"] for note in row["notes"])
    assert found["left"].keys() == {"dropped"}
    assert sum(found["left"]["dropped"].values()) == 40 - found["frames"] > 10
    assert {cause.rpartition(":")[2] for cause in found["left"]["dropped"]} == {"stale"}
    assert found["slowest"][0]["why"][0]["text"] == "infer was slow: 200.0 ms, median 4.0"
    assert any(row["what"] == "release" for row in found["budget"])
    usual = explain_run(write_run(tmp_path / "usual", simulated({}, replace(settings, period_ns=40 * MS)))).as_json()
    assert usual["budget"][0]["what"] == "release"
    assert usual["advice"][0].endswith("there is time to spare")


def test_a_frame_that_lacked_its_core_says_who_had_it(tmp_path: Path) -> None:
    """infer of frame 10 takes 100 ms, for 90 of which the DSP has no core; poses had it for some of them."""

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return (100 if (stage, frame) == ("infer", 10) else STAGE_MS[stage]) * MS

    run = simulate(application_graph(), Settings(20), service, keep=True)
    slow = next(job for job in run.jobs if (job.stage, job.frame) == ("infer", 10))
    jobs = [job._replace(preempted_ns=90 * MS) if job == slow else job for job in run.jobs]
    (row,) = explain_run(write_run(tmp_path / "run", run, jobs, cores=CORES), 1).as_json()["slowest"]
    beside = [job for job in jobs if job.unit == "cpu" and job.begin_ns < slow.end_ns and job.end_ns > slow.begin_ns]
    beside_ms = sum(min(job.end_ns, slow.end_ns) - max(job.begin_ns, slow.begin_ns) for job in beside) / MS
    assert beside_ms >= 2
    why = row["why"][0]
    assert why["text"].replace(" of frame 10", "") == "infer: dsp had no core, and no job of this run had it"
    # 97 of its 100 ms lie after the frame before was presented, which took 3 ms behind infer
    assert why["longer_ms"] == pytest.approx((90 - beside_ms) * 0.97)


def test_what_is_printed(folder: Path, command: Command, check_printed: Callable[[str, str], None]) -> None:
    out, err = command("explain", folder, "--slowest", 3)
    check_printed("explain-run", out.replace(str(folder), "RUN"))
    assert err == ""


def test_one_frame_is_printed(folder: Path, command: Command) -> None:
    lines = command("explain", folder, "--frame", "20")[0].splitlines()
    assert lines[0].startswith("Frame 20: presented ")
    assert [line.split()[1] for line in lines if "composite" in line] == ["composite"]


def test_json_is_the_document(folder: Path, command: Command) -> None:
    out, _ = command("explain", folder, "--slowest", 3, "--json")
    assert json.loads(out) == json.loads(json.dumps(explain_run(folder, 3).as_json()))


def test_jobs_as_csv_are_those_of_the_run(folder: Path, command: Command) -> None:
    target = folder / "jobs.csv"
    _, err = command("explain", folder, "--jobs", target)
    with target.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert err == f"jobs: {target}, {len(rows)} rows\n"
    assert list(rows[0]) == [*COLUMNS, "b", "visible"]
    assert {(row["stage"], row["visible"], row["b"]) for row in rows} == {
        ("pose", "1.0", ""),
        ("raster", "", ""),
        ("infer", "", "2.5"),
        ("composite", "", ""),
        ("present", "", ""),
    }
    assert {row["skips"] for row in rows} == {"0"}
    for row in rows:
        assert int(row["wait_ns"]) == int(row["begin_ns"]) - int(row["ready_ns"]) >= int(row["wait_cause_ns"])
        assert (row["wait_cause"] == "") == (row["wait_ns"] == "0")
        assert int(row["cpu_ns"]) == int(row["end_ns"]) - int(row["begin_ns"])
    busy = [row for row in rows if row["wait_cause"] == "busy"]
    assert busy
    assert all(row["behind_stage"] for row in busy)


def test_jobs_as_parquet_are_those_of_the_csv(folder: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    assert write_jobs(folder, folder / "jobs.parquet") == write_jobs(folder, folder / "jobs.csv")
    table, read = pandas.read_parquet(folder / "jobs.parquet"), pandas.read_csv(folder / "jobs.csv")
    for name, (kind, _) in COLUMNS.items():
        expected = read[name].fillna("") if kind is str else read[name].astype(kind)
        assert list(table[name]) == list(expected), name
    assert table["visible"].sum() == read["visible"].sum() > 0


def test_parquet_without_its_library_names_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingPartError, match="as Parquet needs pyarrow"):
        write_jobs(folder, folder / "jobs.parquet")
    assert not (folder / "jobs.parquet").exists()


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (["--jobs", "jobs.txt"], "a name that ends in .csv or .parquet"),
        (["--jobs", "none/jobs.csv"], "a place that can be written"),
        (["--slowest", 0], "greater than or equal to 1"),
    ],
)
def test_what_is_refused_of_a_run(folder: Path, command: Command, arguments: list[Any], found: str) -> None:
    assert found in command("explain", folder, *arguments, code=2)[1]


def test_a_run_that_goes_on_is_explained_so_far(folder: Path, tmp_path: Path, command: Command) -> None:
    """It is asked for by the name that it will have; its journal ends within a record."""
    (folder / "report.json").unlink()
    journal = folder / NAME
    journal.write_bytes(journal.read_bytes()[: journal.stat().st_size // 2])
    found = explain_run(folder.rename(tmp_path / "run.77.partial")).as_json()
    assert (found["scene"], found["interrupted"]) == ("test", None)
    assert 10 < found["frames"] < 39
    out, _ = command("explain", tmp_path / "run", "--json")
    assert json.loads(out) == json.loads(json.dumps(found))


def test_messages_are_those_of_the_report_or_of_the_journal_so_far(folder: Path) -> None:
    begun, records = open_journal(folder)
    more = (*records, Said(1, "the chip is hot"), Said(2, "it is cool"))
    assert ExplainedRun(folder, begun, more, None).messages == ["the chip is hot", "it is cool"]
    assert explain_run(folder).messages == json.loads((folder / "report.json").read_text())["messages"] == []


def test_a_run_is_found_by_its_name_below_runs(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """Of a run that was killed too, and of one with the name of a scene; without a name it is the newest."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    folder.rename("runs/k9.999999999.partial")
    assert "\nRun runs/k9.999999999.partial: scene test" in command("explain", "k9")[0]
    Path("runs/k9.999999999.partial").rename("runs/far")
    assert "\nRun runs/far: scene test" in command("explain", "far")[0]
    assert command("explain") == command("explain", "far")
    assert "k9: found no such run, expected a run folder with a journal" in command("explain", "k9", code=2)[1]


def test_a_journal_that_is_a_link_to_nothing_is_said_to_be(folder: Path, command: Command) -> None:
    (folder / "report.json").unlink()
    (folder / NAME).unlink()
    (folder / NAME).symlink_to("nothing")
    assert f"{folder}: found {NAME}, a link to a file that is not there" in command("explain", folder, code=2)[1]


@pytest.mark.parametrize(
    ("record", "found"),
    [
        (Accounted(9, "npu", 1), "unit 'npu'"),
        (Worked(JobRecord("own", "cpu", 0, 0, 0, 0, 1), {}), "stage 'own'"),
        (Stepped(9, (UnitDied("npu"),), ()), "unit 'npu'"),
        (None, "facts"),
    ],
)
def test_a_journal_that_contradicts_itself_is_refused(
    tmp_path: Path, record: Record | None, found: str, command: Command
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with JournalWriter(folder / NAME) as journal:
        journal.add(Begun(1, application_graph(), Settings(3), {} if record is not None else {"config": [1]}))
        if record is not None:
            journal.add(record)
    assert found in command("explain", folder, code=2)[1]


@pytest.mark.parametrize("of_machine", [5, {"cpu": 5}, {"cpu": {"cores_allowed": 5}}])
def test_a_machine_of_another_form_is_as_one_that_is_not_known(tmp_path: Path, of_machine: object) -> None:
    begun = Begun(1, application_graph(), Settings(3), {"machine": of_machine})
    with JournalWriter(tmp_path / NAME) as journal:
        journal.add(begun)
    assert explain_run(tmp_path).frames == 0
    assert _cores_allowed(begun) == 0
    assert _cores_allowed(begun._replace(facts={"machine": {"cpu": {"cores_allowed": [0, 2, 5]}}})) == 3


def test_a_folder_without_a_journal_is_refused(folder: Path, tmp_path: Path, command: Command) -> None:
    (folder / NAME).unlink()
    assert f"no {NAME}" in command("explain", folder, code=2)[1]
    with pytest.raises(BadInputError, match=f"no {NAME}"):
        explain_run(folder)
    with pytest.raises(BadInputError, match="none"):
        explain_run(tmp_path / "none")


def test_a_journal_that_was_cut_off_says_so_first(tmp_path: Path, command: Command) -> None:
    """Where its process lives the run goes on; else nobody knows what came after."""
    whole = write_run(tmp_path / "whole", simulated({}))
    assert explain_run(whole).remark == ""
    assert f"Run {whole}: " in command("explain", whole)[0]
    data = (whole / NAME).read_bytes()
    for name, said in (
        ("cut", CUT_OFF),
        (f"gone.{10**9 - 1}.partial", CUT_OFF),
        ("live.5.partial", "the run still goes on: the figures cover its frames so far"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        (folder / NAME).write_bytes(data[: len(data) * 3 // 4])
        with locked(folder) if name == "live.5.partial" else nullcontext():
            assert explain_run(folder).remark == said
            first, second, *_ = command("explain", folder)[0].splitlines()
        assert first == said and second.startswith(f"Run {folder}: ")


def test_a_run_of_one_frame_has_no_frame_time(tmp_path: Path, command: Command) -> None:
    folder = write_run(tmp_path / "run", simulated({}, Settings(1)))
    found = explain_run(folder).as_json()
    assert (found["frames"], found["frame_ms"], found["budget"], found["slowest"]) == (1, None, [], [])
    assert "fewer than two frames" in command("explain", folder)[0]


def test_a_sample_is_evenly_spaced() -> None:
    sample: EvenSample[int] = EvenSample()
    for value in range(3 * MOST_SAMPLES):
        sample.add(value)
    assert sample.values == list(range(0, 3 * MOST_SAMPLES, 4))


def test_advice_is_about_what_bounds_a_tenth_at_least() -> None:
    rows = [
        BudgetRow("pose", "cpu", "preempted", "", 5.0, 0.5),
        BudgetRow("own", "gpu", "work", "", 3.0, 0.3),
        BudgetRow("infer", "dsp", "throttled", "", 1.1, 0.11),
        BudgetRow("present", "cpu", "work", "", 0.9, 0.09),
    ]
    assert advice(rows, "pipelined", -1) == [
        "5.0 ms a frame, pose (preempted): no job of this run had the core: end other programs; threads that spin take "
        "it too",
        "3.0 ms a frame, own (work): shorter work of own, or a unit of its own for it",
        "1.1 ms a frame, infer (throttled): a performance profile with more power, such as `--performance-profile "
        "burst`, caps dsp less",
    ]
    assert "`--policy pipelined`" in advice(rows, "sequential", -1)[0]


@pytest.mark.parametrize(
    ("what", "spare", "found"),
    [
        ("taken", -1, "a smaller `--size`, or another `--runtime`"),
        ("taken", 0, "this machine has a core for every unit: `--cores` gives dsp one of its own"),
        ("work", 0, "a smaller `--size`, or another `--runtime`"),
        ("work", 1, "a smaller `--size`, or another `--runtime`, or more cores for it (`--cores dsp=...`)"),
    ],
)
def test_advice_is_what_this_machine_can_follow(what: str, spare: int, found: str) -> None:
    """With fewer cores than units none has one of its own; only what is left over can go to the network."""
    row = BudgetRow("infer", "dsp", what, "", 5.0, 0.5)
    assert advice([row], "pipelined", spare) == [f"5.0 ms a frame, infer ({what}): {found}"]


@pytest.mark.parametrize(
    ("what", "spare", "found"),
    [
        ("work", 1, "less work in composite, or another unit"),
        ("taken", -1, "less work in composite, or another unit"),
        ("taken", 0, "`cores` of gpu in [units]: a core of its own"),
        ("held", 0, "another `--policy` or `--edge` lets composite begin sooner (docs/policies-and-edges.md)"),
    ],
)
def test_advice_for_a_stage_of_a_pipeline_file_is_not_the_avatars(what: str, spare: int, found: str) -> None:
    """A run of a file refuses --picture, --cores and --latch, and its stages may have any name."""
    row = BudgetRow("composite", "gpu", what, "", 5.0, 0.5)
    assert advice([row], "pipelined", spare, is_of_file=True) == [f"5.0 ms a frame, composite ({what}): {found}"]


def test_what_other_programs_took_is_said_first() -> None:
    rows = [
        BudgetRow("infer", "dsp", "work", "", 6.0, 0.6),
        BudgetRow("pose", "cpu", "preempted", "", 0.6, 0.06),
        BudgetRow("raster", "gpu", "preempted", "", 0.5, 0.05),
    ]
    assert [line.split(":")[0] for line in advice(rows, "pipelined", 0)] == [
        "1.1 ms a frame, pose, raster (preempted)",
        "6.0 ms a frame, infer (work)",
    ]


STAGES = (
    StageSpec("frame", "isp", ()),
    StageSpec("depth", "dsp", (Input("frame"),)),
    StageSpec("seg", "gpu", (Input("frame"),)),
    StageSpec("composite", "cpu", (Input("depth"), Input("seg"))),
)
GRAPH = Graph(STAGES, ("double",) * 3, "composite")
TIMES = {"frame": 2, "depth": 14, "seg": 10, "composite": 3}


def joined(settings: Settings) -> Simulation:
    """A run in which every fifth frame takes seg 10 ms longer."""
    return simulate(
        GRAPH,
        settings,
        lambda stage, _unit, frame, _begin: (TIMES[stage] + 10 * (stage == "seg" and frame % 5 == 0)) * MS,
        keep=True,
    )


def explained(settings: Settings) -> tuple[list[ExplainedJob], Timeline]:
    """The jobs of such a run."""
    made = joined(settings)
    assert made.recording is not None
    timeline = Timeline(GRAPH, made.recording.settings, waits=True)
    records = list(journal_of(made.recording, made.jobs, {}, made.report))
    assert any(isinstance(record, Worked) for record in records) and isinstance(records[1], Stepped)
    facts = [fact for record in records[1:] for fact in timeline.add(record)]
    return [fact for fact in facts if isinstance(fact, ExplainedJob)], timeline


def test_a_join_waited_for_what_came_last_of_each_frame() -> None:
    """Depth ends 4 ms after seg, but every fifth frame 6 ms before it."""
    jobs, _ = explained(Settings(40, period_ns=20 * MS))
    joins = Joins(GRAPH)
    for job in jobs:
        joins.add(job)
    assert joins.rows() == {"composite": {"depth": JoinInput(32, 4.0), "seg": JoinInput(8, 6.0)}}
    assert join_text("composite", joins.rows()["composite"]) == (
        "composite waited for depth in 32 of 40 jobs, 4.00 ms after the others; "
        "for seg in 8 of 40 jobs, 6.00 ms after the others"
    )


def test_an_idle_unit_says_which_stage_its_join_waits_for() -> None:
    """The CPU waits from the end of what came first to the end of what came last: 4 ms for depth, or 6 ms for seg."""
    settings = Settings(10, "sequential", in_flight=1)
    made = joined(settings)
    assert made.recording is not None
    timeline = Timeline(GRAPH, settings, idle=True)
    records = list(journal_of(made.recording, made.jobs, {}, made.report))
    facts = [*(fact for record in records[1:] for fact in timeline.add(record)), *timeline.end()]
    joins = [fact for fact in facts if isinstance(fact, IdleSlice) and fact.cause == JOIN]
    usual, fifth = ("cpu", "depth", 4 * MS), ("cpu", "seg", 6 * MS)
    assert [(each.unit, each.late, each.end_ns - each.begin_ns) for each in joins] == [fifth, *[usual] * 4] * 2


def test_the_critical_path_goes_on_with_the_input_that_came_last() -> None:
    """One frame at a time: the path works 14 ms in depth for frames that depth was last of, else 20 ms in seg."""
    settings = Settings(40, "sequential", in_flight=1)
    jobs, timeline = explained(settings)
    paths = Paths(GRAPH, settings, timeline.downs)
    budget = Budget(paths)
    for job in jobs:
        paths.add(job)
        if job.presented is not None:
            budget.present(job)
    ns = budget.close()
    work = {stage: of / MS for (what, stage), of in ns.items() if what == WORK}
    # The span is from the end of frame 0 to that of frame 39: it has the frames 1 to 39, of which 7 are fifth ones.
    assert work == {"frame": 2.0 * 39, "depth": 14.0 * 32, "seg": 20.0 * 7, "composite": 3.0 * 39}
