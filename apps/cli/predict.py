"""`trilane predict`: a configuration, or a table of them, on a chip that is described by a hardware profile.

Rule: this module reads options; every figure comes from `trilane.hw_profiles`, and `predict_output.py` shows them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from trilane.apps.cli.commands import Commands, JsonOption, with_options
from trilane.apps.cli.console import say, stderr_console
from trilane.apps.cli.predict_file import predict_pipeline_file
from trilane.apps.cli.predict_output import draw, show_answer, show_networks, show_table
from trilane.apps.cli.predict_pipelines import predict_pipelines
from trilane.apps.predict.asked_prediction import answer_of, application_of, predict_networks
from trilane.apps.predict.predict_options import PredictOptions

if TYPE_CHECKING:
    from pathlib import Path

    from trilane.hw_profiles.application import Plan
    from trilane.hw_profiles.schema import Profile

app = Commands()

EPILOG = """\b
Examples:
  trilane predict
  trilane predict --encoder resnet18 --size 512 --channels 16
  trilane predict --unit gpu --norm instance --minutes 30
  trilane predict --policy pipelined --edge double --what-if
  trilane predict --policy latest --fps 24
  trilane predict --performance-profile burst --minutes 30 --plot temperature.svg
  trilane predict --avatar hiker --unit gpu
  trilane predict --policy latest --fps 24 --trace predicted.pftrace
  trilane predict --network midas.onnx --network unet.onnx --profile snapdragon-8-gen-3
  trilane predict --network net.onnx --input-shape image=1x3x224x224 --precision w8a8
  trilane predict --network net.onnx --runtime qnn_dlc --performance-profile sustained_high_performance
  trilane predict --network net.onnx --fps 30 --minutes 30
  trilane predict --network net.onnx --power-limit-w 3
  trilane predict --network unet.onnx --application --fps 30 --what-if
  trilane predict --table rows.csv --json
  trilane predict portrait --beside default --beside network.onnx@30
  trilane predict street.toml --profile snapdragon-8-gen-3
  trilane predict portrait --beside street.toml@15
  trilane predict street.toml --set stages.segmenter.unit=gpu --set run.fps=60,run.policy=latest
"""
PLOT_MINUTES = 30.0


@app.command(epilog=EPILOG)
@with_options(PredictOptions)
def predict(options: PredictOptions, *, json: JsonOption = False) -> None:
    """Predict frame time, idleness, heat and energy on a chip, with the error to expect.

    Without options: the avatar, policy and edge of `trilane run`. With --encoder, --norm, --size or --channels: the
    published application with such a network. With --network: each network by itself, or with --application in the
    avatar's place. With a pipeline file: this pipeline, from the times of its stages (docs/pipeline-file.md).

    Without --performance-profile, a network by itself runs under burst, because published latencies do. On the profile
    `host` (this machine), everything runs under burst, because a run here has no cap.
    """
    from trilane.hw_profiles.profile_files import load_runnable

    options.check_together()
    if options.pipeline is not None:
        predict_pipeline_file(options, options.pipeline, json)
        return
    if options.scene is not None:
        predict_pipelines(options, json)
        return
    chip = load_runnable(options.profile)
    if options.table is not None:
        show_table(chip.name, options.cap, _predict_table(chip, options.table, options), json)
        return
    if options.is_bare:
        show_networks(chip, options, predict_networks(chip, options, say), json)
        return
    chip, plan = application_of(chip, options, say)
    answer = answer_of(chip, plan, options)
    if options.plot is not None:
        draw(chip, plan, options.cap, options.minutes or PLOT_MINUTES, options.governor, options.plot)
    if options.trace is not None:
        _write_trace(chip, plan, options, answer, options.trace)
    show_answer(answer, json)


def _write_trace(chip: Profile, plan: Plan, options: PredictOptions, answer: dict[str, Any], target: Path) -> None:
    """Write the simulated run behind the predicted shares of time as a trace."""
    from trilane.apps.explain.trace import write_predicted
    from trilane.hw_profiles.predict import predicted_run

    done = predicted_run(chip, plan, options.cap, options.wanted)
    write_predicted({chip.name: done}, {key: answer[key] for key in ("machine", "config")}, target)


def _predict_table(chip: Profile, path: Path, options: PredictOptions) -> list[dict[str, Any]]:
    """Return an answer for each row of the table."""
    from rich.progress import Progress

    from trilane.hw_profiles.predict import predict_table
    from trilane.hw_profiles.reference_networks import read_table

    rows = read_table(path)
    console = stderr_console()
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("predicting", total=len(rows))
        answers = predict_table(
            chip, rows, options.cap, options.variant, lambda count: progress.update(task, completed=count)
        )
        return list(answers)
