"""Verdicts: what passes, by hand; the same bound wherever it is said, in 20 runs; advice that the numbers support.

Which runs are trusted: each fact at its limit, alone and with the others.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from support.run_folders import write_run
from support.run_report import TIMES, make_report
from trilane.apps.explain.explained_run import explain_run
from trilane.apps.interface import load_run
from trilane.apps.predict.predicted_verdict import pipeline_verdict, predicted_verdict
from trilane.apps.run.report import Report, read_report
from trilane.apps.run.verdict import COMPUTED, SO_FAR, Facts, LateFrames, NamedBound, Rate, Trust, judged, trust_of
from trilane.apps.run.verdict_facts import facts_of, verdict_of
from trilane.apps.watch.followed_run import FollowedRun
from trilane.apps.watch.live_figures import looks
from trilane.hw_profiles.prediction import ApplicationPrediction, MeanTime, PredictedStage, PredictedTimes
from trilane.hw_profiles.rates import FrameInterval, holding
from trilane.machine import Machine
from trilane.pipeline.journal import records_of
from trilane.pipeline.reckoning import reckoned
from trilane.pipeline.run_metrics import ProcessorState
from trilane.pipeline.surroundings import processor_of
from trilane.scheduler.events import Graph, Settings, chain
from trilane.scheduler.placement import Place
from trilane.scheduler.policy import run_settings
from trilane.scheduler.virtual import simulate

QUIET = Trust(True, ("quiet machine (other programs 0.4 %)",))
FAST = Facts(Rate(96.0, 92.0, 102.0), 30.0, LateFrames(299, 0), QUIET, frame_ms=10.4)
US = 1000


def test_of_two_avatars_alike_a_known_worst_view_counts() -> None:
    avatar = {"source": "validation", "psnr_db": 31.0}
    accuracy = {
        "one": avatar,
        "two": avatar | {"worst": {"psnr_db": 25.5}},
        "three": avatar | {"worst": {"psnr_db": None}},
    }
    image = facts_of(Report.model_validate(make_report()), {}, accuracy).image
    assert image == "31.0 dB, worst view 25.5 (validation); this run: --check 4"
    image = facts_of(Report.model_validate(make_report()), {}, {"one": avatar}).image
    assert image == "31.0 dB (validation); this run: --check 4"


@pytest.mark.parametrize(
    ("change", "passed", "why"),
    [
        ({}, True, "30 fps are held"),
        ({"rate": Rate(30.0)}, True, "30 fps are held"),
        ({"rate": Rate(29.5)}, False, "29.5 of 30 fps"),
        ({"rate": Rate(31.0, 29.0, 33.0)}, True, "the interval of the rate holds 30 fps, so another run may differ"),
        ({"rate": Rate(29.9), "is_held_to_rate": True}, True, "30 fps are held"),
        ({"lateness": LateFrames(300, 3)}, True, "30 fps are held"),  # 1 % of them
        ({"lateness": LateFrames(300, 4)}, False, "4 of 300 frames late at 30 fps"),
        ({"lateness": LateFrames(300, 1, 2, 1)}, False, "1 of 300 frames late, 2 dropped, 1 lost at 30 fps"),
        ({"lateness": LateFrames(34, 0, replaced=85)}, True, "30 fps are held"),  # the rate is of those that were shown
        ({"failure": "gpu is gone"}, False, "the run failed: gpu is gone"),
        ({"rate": None, "lateness": None}, False, "the rate is not known: fewer than two frames were presented"),
        ({"target_fps": 60.0}, True, "60 fps are held"),
        ({"target_fps": 97.0}, False, "96 of 97 fps"),
        ({"rate": Rate(29.97)}, False, "29.97 of 30 fps"),  # with three digits both are 30
        ({"rate": Rate(119.999), "target_fps": 120.0}, False, "119.999 of 120 fps"),
    ],
)
def test_what_passes(change: dict[str, Any], passed: bool, why: str) -> None:
    verdict = judged(replace(FAST, **change))
    assert (verdict.passed, verdict.as_json()["pass"]) == (passed, passed)
    assert why in verdict.why.split("; ")
    assert verdict.why.endswith("quiet machine (other programs 0.4 %)")
    assert verdict.lines()[0][0] == ("PASS" if passed else "FAIL")


def test_a_machine_that_is_not_quiet_does_not_change_what_passes_but_is_said() -> None:
    verdict = verdict_of(Report.model_validate(make_report(other_programs=0.27)), "runs/a")
    lines = dict(verdict.lines())
    assert (verdict.passed, verdict.as_json()["trusted"]) == (True, False)
    assert lines["TRUST"] == "UNSURE: other programs took 27 % of its cores"
    assert lines["TRY"] == "end other programs (27 %) and run again; trilane explain runs/a"


def report_of(**changes: Any) -> Report:
    return Report.model_validate(make_report(other_programs=0.004, **changes))


def test_advice_follows_from_the_numbers() -> None:
    """The stage that bounds a slow run; a later pose where a frame alone is quick; more work where time is left."""
    slow = report_of(fps=20.0, deadline_misses=2)
    assert dict(verdict_of(slow, "r").lines())["TRY"].startswith("infer: a smaller --size, or another --runtime; ")
    two = {unit: make_report()["units"]["dsp"] for unit in ("dsp", "x")}
    alone = report_of(fps=20.0, policy="sequential", units=two)
    assert dict(verdict_of(alone, "r").lines())["TRY"].startswith("--policy pipelined: ")
    baseline = {**make_report()["baseline"], "latency_ms": {**TIMES, "mean": 9.9}}
    assert "--latch 3" in dict(verdict_of(report_of(baseline=baseline), "r").lines())["TRY"]
    quick = verdict_of(report_of(fps=90.0), "r")
    assert "a larger --picture: 67 % of each frame's time is left" in dict(quick.lines())["TRY"]


def test_a_prediction_is_sure_where_its_interval_is_on_one_side() -> None:
    """66.7 fps, 50 to 100: above 30 and below 120, but 60 lies within."""
    for fps, passed, trusted in ((30, True, True), (60, True, False), (120, False, True)):
        found = predicted_verdict(predicted((15.0, 10.0, 20.0), fps, gpu=9.0, dsp=12.0)).as_json()
        assert (found["pass"], found["trusted"]) == (passed, trusted)
        assert found["bound"] == {"unit": "dsp", "stages": ["of dsp"], "share": 0.8}


def predicted(frame_ms: tuple[float, ...], fps: float = 30.0, /, **ms: Any) -> ApplicationPrediction:
    """A prediction with a stage on each unit, and further fields."""
    stages = {
        f"of {unit}": PredictedStage(unit=unit, service_ms=MeanTime(mean=ms.pop(unit)))  # type: ignore[arg-type]
        for unit in ("cpu", "gpu", "dsp")
        if unit in ms
    }
    times = PredictedTimes.model_construct(mean=frame_ms[0], low=frame_ms[1], high=frame_ms[2])
    config, known = (
        SimpleNamespace(fps=fps),
        {"latency_ms": MeanTime(mean=20.0), "units": {}, "display_capped": False, "timeline": ()},
    )
    known["fps_start"] = ms.get("fps", 0.0)
    return ApplicationPrediction.model_construct(frame_time_ms=times, config=config, stages=stages, **known | ms)


def test_what_the_display_holds_back_is_bound_by_it() -> None:
    """The display shows a frame every 16.6 ms, 60.2 fps; the stages need 9 ms. A rate below that is no display's."""
    held = {"gpu": 9.0, "display_capped": True, "fps": 1e3 / 16.6}
    shown = (16.6, 16.6, 16.6)
    found = predicted_verdict(predicted(shown, **held))
    lines = dict(found.lines())
    assert lines["BOUND"] == (
        "display: 16.6 of 16.6 ms a frame (100 %); it shows no more frames a second; of stages most of gpu 9.0"
    )
    assert lines["TRUST"] == "computed; the display holds the rate over the whole 80 % interval"
    slow = predicted_verdict(predicted(shown, **held, rate=holding(100.0, FrameInterval(*shown))))
    assert (slow.passed, slow.as_json()["bound"]["unit"]) == (False, "display")
    left = holding(30.0, FrameInterval(9.0, 8.0, 10.0))
    quick = predicted_verdict(predicted((33.3, 33.3, 33.3), **{**held, "fps": 30.0}, rate=left))
    assert (quick.passed, quick.as_json()["bound"]["unit"]) == (True, "gpu")


def test_the_display_is_no_bound_where_heat_takes_frames() -> None:
    """At first the display shows 60.2 fps. Over all minutes the mean is 50 fps: the hot gpu is slower than it."""
    hot = predicted((20.0, 20.0, 20.0), gpu=19.0, display_capped=True, fps=50.0, fps_start=1e3 / 16.6)
    found = predicted_verdict(hot)
    assert found.as_json()["bound"]["unit"] == "gpu"
    assert not dict(found.lines())["TRUST"].startswith("computed; the display")


def test_frames_that_gave_way_to_newer_ones_are_told_beside_the_rate() -> None:
    found = judged(replace(FAST, lateness=LateFrames(34, 0, replaced=85)))
    assert "at 30 fps 0 of 34 frames late, 85 replaced by newer ones" in dict(found.lines())["PASS"]


def test_a_rate_beside_another_one_says_which_it_is() -> None:
    """30.9 fps of a source at 30: what was shown, from the first frame on. 59 fps: what a prediction could have."""
    paced = replace(FAST, rate=Rate(30.9), is_held_to_rate=True, lateness=LateFrames(300, 1, 2))
    computed = replace(FAST, rate=Rate(59.0), source=COMPUTED)
    said = {
        paced: "30.9 fps shown, asked for 30 fps: 1 of 300 frames late, 2 dropped",
        replace(paced, source=SO_FAR): "30.9 fps shown so far, asked for 30 fps: 1 of 300 frames late, 2 dropped",
        computed: "59 fps computed if always fed, at 30 fps 0 of 299 frames late",
        replace(computed, lateness=None): "59 fps computed, asked for 30 fps",  # the only rate that there is
        FAST: "96 fps (92 to 102), at 30 fps 0 of 299 frames late",
    }
    assert {facts: judged(facts).lines()[0][1] for facts in said} == said


def test_stages_that_round_to_no_time_bound_nothing_that_is_told() -> None:
    bound = NamedBound(
        "cpu", {"a": 3.0, "end": 0.004, "b": 0.006, "c": None}, 0.5, of_unit=frozenset({"a", "b", "c", "end"})
    )
    said = dict(judged(replace(FAST, bound=bound)).lines())["BOUND"]
    assert said.startswith("cpu: a 3.0 + b 0.01 + c of 10.4 ms ")


def test_frames_that_every_leaves_out_are_not_dropped_ones() -> None:
    """Of 300 frames a stage takes each second one: 147 came, 3 went because they were stale, 1 was late."""
    dropped = {"a->b:every": 150, "a->b:stale": 3}
    rate = holding(30.0, FrameInterval(15.0, 12.0, 18.0)).as_json()
    found = pipeline_verdict(simulated(frames={"presented": 147, "dropped": dropped}, deadline_misses=1, rate=rate))
    assert "1 of 150 frames late, 3 dropped at 30 fps" in str(found.as_json())


@pytest.mark.parametrize("times", [{"samples": 0}, {"samples": 0, "mean": None}], ids=["older", "new"])
def test_a_run_of_one_frame_says_what_is_not_known(times: dict[str, Any]) -> None:
    """Its report has null where an older one had 0, and reads the same; the latency of the one frame is known."""
    none = {**dict.fromkeys([*TIMES, "ema20_min", "ema20_max", "jitter"], 0.0), **times}
    frames = {"requested": 1, "presented": 1, "lost": 0, "lost_by_cause": {}, "dropped": {}, "not_begun": 0}
    alone = {"frames": frames, "frame_time_ms": none, "fps": 0.0, "bottleneck": None, "bound": None}
    baseline = {**make_report()["baseline"], **alone}
    report = report_of(**alone, latency_ms={**TIMES, "mean": 36.0, "samples": 1}, baseline=baseline)
    document = report.as_json()
    assert (document["fps"], document["bound"], document["bottleneck"]) == (None, None, None)
    assert {key: value for key, value in document["frame_time_ms"].items() if value is not None} == {"samples": 0}
    assert Report.model_validate(document) == report
    verdict = verdict_of(report)
    lines = dict(verdict.lines())
    assert lines["FAIL"] == "the rate is not known: fewer than two frames were presented"
    assert (lines["TIME"], lines["BOUND"]) == ("not known, latency 36 ms", "not known")
    assert (verdict.passed, verdict.as_json()["bound"]) == (False, None)


def test_stages_that_take_no_time_bound_nothing() -> None:
    found = pipeline_verdict(simulated(needs_ms={"mean": 0.0, "low": None, "high": None}, ms=0.0))
    assert (found.passed, found.as_json()["bound"]) == (True, None)


def test_a_prediction_without_a_presented_frame_has_no_latency() -> None:
    frames = {"presented": 0, "lost": 0, "dropped": {"a->b:late": 300}}
    for latency, told in (({"mean": 0, "samples": 0}, False), ({"mean": 20.5, "samples": 3}, True)):
        verdict = pipeline_verdict(simulated(frames=frames, latency_ms=latency))
        assert ("latency 20" in dict(verdict.lines())["TIME"]) == told == ("latency" in dict(verdict.lines())["TIME"])


def simulated(ms: float = 9.0, **changes: Any) -> dict[str, Any]:
    """The prediction of a pipeline of one stage."""
    return {
        "needs_ms": {"mean": 15.0, "low": 12.0, "high": 18.0},
        "stages": {"a": {"unit": "u", "alone_ms": ms, "service_ms": {"mean": ms}}},
        **{"units": {}, "frames": {"presented": 300, "dropped": {}}, "deadline_misses": 0},
        "latency_ms": {"mean": 20.0, "samples": 300},
        **changes,
    }


#: A pipeline like the avatar's, whose stages have units of their own or share them.
UNIT_OF = {"pose": "cpu", "raster": "gpu", "infer": "dsp", "composite": "gpu", "present": "cpu"}
SCENES = {
    "network": {"pose": 200, "raster": 900, "infer": 2600, "composite": 800, "present": 500},
    "picture": {"pose": 200, "raster": 1300, "infer": 1500, "composite": 2400, "present": 900},
    "encoder": {"pose": 1500, "raster": 700, "infer": 1600, "composite": 700, "present": 3600},
    "even": {"pose": 1000, "raster": 1000, "infer": 2000, "composite": 1000, "present": 1000},
}
HELD = ("infer", "composite", "present")
PLACES = {"cpu": Place((0,), 1), "gpu": Place((1,), 1), "dsp": Place((2,), 1)}
RUNS = [
    *((scene, policy, "") for scene in SCENES for policy in ("pipelined", "sequential")),
    *((scene, "pipelined", held) for scene in SCENES for held in HELD),
]


def test_there_are_20_runs() -> None:
    assert len(set(RUNS)) == 20


@pytest.mark.parametrize(("scene", "policy", "held"), RUNS)
def test_the_bound_is_the_same_wherever_it_is_said(scene: str, policy: str, held: str, tmp_path: Path) -> None:
    """report.json, `explain`, `watch`, the dashboard and Python; a stage held 30 % longer is named where it has most.

    On cores of their own the unit with the most work bounds a pipelined run, and its longest stage is in that unit.
    """
    pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")
    from trilane.apps.dashboard.finished_view import FinishedView

    times = {name: us * (13 if name == held else 10) // 10 for name, us in SCENES[scene].items()}
    graph: Graph = chain(UNIT_OF.items(), "double", "composite")
    settings: Settings = run_settings(policy, 130, 1_000_000 // 30 * US)
    run = simulate(graph, settings, lambda stage, *_: times[stage] * US, keep=True)
    assert run.recording is not None
    figures = reckoned(graph, settings, PLACES, records_of(run.recording, run.jobs)).figures
    folder = write_run(tmp_path / "run", run, cores={unit: place.cores for unit, place in PLACES.items()})
    rows = {name: {**make_report()["stages"]["infer"], "unit": unit} for name, unit in UNIT_OF.items()}
    report = make_report(**figures, stages=rows, other_programs=0.0)
    report["config"]["scene"] |= {"fps": 30, "avatars": [{"bundle": "default"}]}
    verdict = verdict_of(Report.model_validate(report)).as_json()
    (folder / "report.json").write_text(json.dumps(report | {"verdict": verdict}), encoding="utf-8")

    own = read_report(folder)
    assert own.verdict is not None and own.verdict.bound is not None
    bound = own.verdict.bound.as_json()
    assert (bound["unit"], bound["stages"][0]) == (figures["bottleneck"], figures["bound"]["stage"]["name"])
    explained = explain_run(folder).as_json()
    assert (explained["bottleneck"], explained["bound"]["stage"]["name"]) == (bound["unit"], bound["stages"][0])
    (look,) = looks(FollowedRun(folder), lambda: None)
    view = FinishedView(folder)
    states = [message for message in view.greeting() if message["type"] == "state"]
    view.close()
    shown = (explained["verdict"], look.as_json()["verdict"], states[0]["verdict"], load_run(folder).verdict.as_json())
    assert [dict(each or {})["bound"] for each in shown] == [bound] * 4
    assert {json.dumps(each["lines"][2]) for each in shown[:3] if each} == {
        json.dumps(list(load_run(folder).verdict.lines()[2]))
    }
    if policy == "pipelined":
        by_unit = {unit: sum(us for name, us in times.items() if UNIT_OF[name] == unit) for unit in PLACES}
        full = [unit for unit, us in by_unit.items() if us == max(by_unit.values())]
        if held and UNIT_OF[held] in full and len(full) == 1:
            assert bound["unit"] == UNIT_OF[held]
            longest = max((name for name in times if UNIT_OF[name] == bound["unit"]), key=times.__getitem__)
            assert bound["stages"][0] == longest


QUIET_FACTS = {"clock": "host", "other_programs": 0.004}


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({}, "quiet machine (other programs 0.4 %)"),
        ({"other_programs": 0.05}, "quiet machine (other programs 5.0 %)"),
        ({"other_programs": 0.0501}, "UNSURE: other programs took 5.0 % of its cores"),
        ({"other_programs": 0.27}, "UNSURE: other programs took 27 % of its cores"),
        ({"other_programs": None}, "UNSURE: nobody knows what other programs took of its cores"),
        ({"other_programs": 0.5, "clock": "virtual"}, "computed in virtual time"),
        ({"temperature_c": {"sensor": 89.9}}, "quiet machine (other programs 0.4 %)"),
        ({"temperature_c": {"sensor": 90.0}}, "UNSURE: the hottest sensor had 90 °C at the end"),
        ({"processor": {"throttles": 0}}, "quiet machine (other programs 0.4 %)"),
        ({"processor": {"throttles": 1}}, "UNSURE: heat slowed its cores down 1 time"),
        ({"processor": {"clock_begin_ghz": 3.0, "clock_end_ghz": 2.71}}, "quiet machine (other programs 0.4 %)"),
        (
            {"processor": {"clock_begin_ghz": 3.0, "clock_end_ghz": 2.5}},
            "UNSURE: the clock of its cores changed from 3.00 to 2.50 GHz",
        ),
        (
            {"processor": {"clock_begin_ghz": 2.5, "clock_end_ghz": 3.0}},
            "UNSURE: the clock of its cores changed from 2.50 to 3.00 GHz",
        ),
        (
            {"other_programs": 0.3, "processor": {"throttles": 4}, "temperature_c": {"sensor": 99.0}},
            "UNSURE: other programs took 30 % of its cores; heat slowed its cores down 4 times; "
            "the hottest sensor had 99 °C at the end",
        ),
    ],
)
def test_each_fact_that_spoils_a_run_is_said(facts: dict[str, Any], said: str) -> None:
    trust = trust_of(QUIET_FACTS | facts)
    assert trust.said == said
    assert trust.trusted is not said.startswith("UNSURE")


def test_the_processor_is_looked_at_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    facts = iter([(3.0, 5), (2.0, 7)])

    class Here(Machine):
        def __init__(self, clock: float, count: int) -> None:
            self.core_clock_ghz = lambda cores: clock if cores == [1] else None  # type: ignore[method-assign,assignment]
            self.throttles = lambda cores: count if cores == [1] else None  # type: ignore[method-assign,assignment]

    monkeypatch.setattr("trilane.machine.here", Here(*next(facts)))
    state = processor_of([1])
    monkeypatch.setattr("trilane.machine.here", Here(*next(facts)))
    assert state() == ProcessorState(clock_begin_ghz=3.0, clock_end_ghz=2.0, throttles=2)
    assert processor_of([0])() == ProcessorState()
