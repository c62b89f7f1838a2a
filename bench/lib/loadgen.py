"""A run evaluated by MLCommons LoadGen: it asks, it measures, and its own summary says whether the run is valid.

Rule: LoadGen decides when a query comes and what counts; here its queries become frames, and the answers go back.
"""

from __future__ import annotations

import importlib
import math
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trilane.bench.lib.load import WARM_UP, Load, Queries, queries_needed
from trilane.errors import MissingPartError, TrilaneError
from trilane.pipeline.controls import FrameRequestQueue

NAMES = {"single-stream": "SingleStream", "multi-stream": "MultiStream", "server": "Server", "offline": "Offline"}
VERDICT = re.compile(r"^Result is : (\w+)", re.MULTILINE)
SAMPLES = 64  # size of the library that LoadGen draws from; whichever it draws, the motion's next frame is presented
SUMMARY = "mlperf_log_summary.txt"


def load_generator() -> Any:
    """Return the module `mlperf_loadgen`. Raises MissingPartError."""
    try:
        return importlib.import_module("mlperf_loadgen")
    except ImportError:
        raise MissingPartError("LoadGen is not installed", extra="loadgen") from None


@dataclass
class LoadGenVerdict:
    """LoadGen's verdict.

    `valid`: whether LoadGen calls the run valid. `summary`: its text as LoadGen wrote it.
    """

    valid: bool = False
    summary: str = ""


@dataclass
class LoadGenPlayer:
    """Lets LoadGen ask a run for frames.

    `load`: pattern and its limits, which LoadGen gets.
    `queries`: times of the same frames, which also show an early end of the run.
    `verdict`: LoadGen's verdict, which `play` fills in.
    """

    load: Load
    queries: Queries
    verdict: LoadGenVerdict = field(default_factory=LoadGenVerdict)
    _ids: list[int] = field(default_factory=list)
    _begun: bool = False
    _completed: int = 0

    def answered(self, frame: int) -> None:
        """Pass a presented frame on to LoadGen, as a sample after the warm-up; the `FrameRequestQueue` calls this."""
        self.queries.answered(frame)
        if self._begun and not self.queries.over:
            self._completed = frame - WARM_UP + 1
            self._complete(frame - WARM_UP)

    def unanswered(self, causes: Mapping[str, int]) -> None:
        """Note a dropped or lost frame, which voids the rest of the run; the `FrameRequestQueue` calls this."""
        self.queries.unanswered(causes)
        self.ended()

    def ended(self) -> None:
        """Note that the run is over; the `FrameRequestQueue` calls this."""
        self.queries.ended()
        if self._begun:
            with self.queries.changed:  # no sample is completed twice, whichever thread comes first
                numbers = range(self._completed, len(self._ids))
                self._completed = len(self._ids)
            for number in numbers:
                self._complete(number)

    def play(self, requests: FrameRequestQueue) -> None:
        """Warm up, then let LoadGen ask until it has enough answers. Raises TrilaneError when the run ends first."""
        lg = load_generator()
        self.queries.warm_up(requests)
        self._begun = True

        def issue(samples: list[Any]) -> None:
            self._ids += [sample.id for sample in samples]
            self.queries.ask(requests, len(samples))
            if self.queries.over:
                self.ended()

        system = lg.ConstructSUT(issue, lambda: None)
        library = lg.ConstructQSL(SAMPLES, SAMPLES, lambda _: None, lambda _: None)
        try:
            with tempfile.TemporaryDirectory(prefix="trilane-loadgen-") as folder:
                lg.StartTestWithLogSettings(system, library, self._settings(lg), _logs(lg, folder))
                self.verdict.summary = (Path(folder) / SUMMARY).read_text(encoding="utf-8")
        finally:
            lg.DestroyQSL(library)
            lg.DestroySUT(system)
        if self.queries.over:
            raise TrilaneError(self.queries.why or "the run ended before LoadGen had its answers")
        line = VERDICT.search(self.verdict.summary)
        self.verdict.valid = line is not None and line[1] == "VALID"

    def _complete(self, number: int) -> None:
        lg = load_generator()
        lg.QuerySamplesComplete([lg.QuerySampleResponse(self._ids[number], 0, 0)])

    def _settings(self, lg: Any) -> Any:
        load = self.load
        settings = lg.TestSettings()
        settings.scenario = getattr(lg.TestScenario, NAMES[load.scenario])
        settings.mode = lg.TestMode.PerformanceOnly
        settings.min_duration_ms = math.ceil(load.seconds * 1e3)
        settings.min_query_count = queries_needed(load.percentile)
        settings.server_target_qps = load.rate
        settings.server_target_latency_ns = round(load.limit_ms * 1e6)
        settings.server_target_latency_percentile = load.percentile
        settings.single_stream_target_latency_percentile = load.percentile
        settings.multi_stream_target_latency_percentile = load.percentile
        settings.multi_stream_samples_per_query = load.samples
        settings.offline_expected_qps = load.rate
        settings.schedule_rng_seed = load.seed
        return settings


def _logs(lg: Any, folder: str) -> Any:
    output = lg.LogOutputSettings()
    output.outdir = folder
    output.copy_summary_to_stdout = False
    settings = lg.LogSettings()
    settings.log_output = output
    settings.enable_trace = False
    return settings
