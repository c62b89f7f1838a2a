"""A run that lasts takes no more memory than a shorter one, in any of its processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.doubles import pipeline_of_doubles as doubles
from trilane.pipeline import result as output
from trilane.pipeline.journal import Sampled, Worked, read_journal
from trilane.pipeline.result import JournalFile
from trilane.pipeline.run import SKETCHED, run_pipeline
from trilane.scheduler.stats import MOST_EXACT, MOVED_AT_ONCE

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("nothing_left")]

#: When the values that were kept are all in the sketches; from then on nothing may grow.
SETTLED = MOST_EXACT + MOST_EXACT // MOVED_AT_ONCE
FRAMES = SETTLED + 20_000
#: Python's smallest object: a list of one number per frame would take more.
BYTES_PER_FRAME = 24


@pytest.mark.timeout(600)
def test_memory_does_not_grow_with_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "SAMPLE_NS", 1_000_000_000)
    pipeline = doubles(pose=0, raster=0, infer=0, composite=0, present=0)
    result = run_pipeline(pipeline, FRAMES, journal=JournalFile(tmp_path / "j", {}))
    assert (result.presented, result.report.percentiles) == (FRAMES, SKETCHED)
    presented, memory = 0, list[tuple[int, dict[str, float]]]()
    for record in read_journal(tmp_path / "j"):
        presented += isinstance(record, Worked) and record.job.stage == "present"
        if isinstance(record, Sampled):
            memory.append((presented, {**record.values}))
    (first, before), *_, (last, after) = [row for row in memory if row[0] > SETTLED]
    assert last - first > 10_000
    for name in ("scheduler", "cpu", "gpu", "dsp"):
        grown = after[f"memory_bytes.{name}"] - before[f"memory_bytes.{name}"]
        assert grown < BYTES_PER_FRAME * (last - first), name
