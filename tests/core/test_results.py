"""What `make results` wrote is of the sweep that stands beside it; examples of sweeps and flicker are what they say."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from trilane.apps.cli.sweep import of_file
from trilane.apps.compare.pages import MOST_STILLS
from trilane.apps.sweep.definition import trials_of
from trilane.bench.lib.cast import Cast
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
EXAMPLES = RESULTS.parent / "examples"
MOST_BYTES = 2_000_000


def test_every_trial_of_the_sweep_is_in_the_table_with_its_command() -> None:
    _, definition, command = of_file([str(RESULTS / "runs.toml")], False, None, None)
    lines = {trial.line for trial in trials_of(definition, command.words_of)}
    rows = list(csv.DictReader((RESULTS / "report.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["command"] for row in rows} == lines
    assert all(float(row["frame_ms"]) > 0 and float(row["psnr_db"]) > 0 for row in rows)
    assert all(row["error_source"].startswith("measured in this run") for row in rows)


def test_the_page_is_small_and_asks_for_nothing() -> None:
    page = (RESULTS / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < MOST_BYTES
    sources = re.findall(r"""<[^>]*\s(?:src|href)=["']([^"']{1,16})""", page)
    assert len(sources) == MOST_STILLS and all(source.startswith("data:image/jpeg") for source in sources)


def test_the_sweep_of_networks_has_60_trials_by_six_axes() -> None:
    _, definition, command = of_file([str(EXAMPLES / "network-sweep.toml")], False, None, None)
    trials = trials_of(definition, command.words_of)
    assert len({trial.id for trial in trials}) == 60
    assert set(definition.axes) == {"size", "channels", "width", "runtime", "calibration", "edge"}
    assert all(len({trial.options[name] for trial in trials}) == len(definition.axes[name]) for name in definition.axes)


def test_the_camera_of_the_slow_scene_moves_and_nobody_else() -> None:
    checked = configure(RunOptions(scene=str(EXAMPLES / "slow-camera.toml"), runtime="ort"), EXAMPLES)
    cast = Cast(checked)
    (first,), (last,) = cast.seen(0), cast.seen(9)
    assert np.abs(first.pose - last.pose).max() < 1e-4
    assert 0.01 < np.abs(first.view - last.view).max() < 0.1
