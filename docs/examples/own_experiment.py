"""An experiment of your own: policies times edges, the error beside the speed. Cells begin with `# %%`."""

# %% [markdown]
# Each combination is run once here. Two runs differ by more than the interval of one: repeat them in turns before you
# call one faster. `FRAMES=20 python own_experiment.py` is short; `OUT` is a folder for the runs.

# %%
import os
from pathlib import Path

import trilane

frames = int(os.environ.get("FRAMES", "120"))
place = Path(os.environ.get("OUT", "runs/own-experiment"))
policies, edges = ("sequential", "pipelined", "latest"), ("single", "double")
runs = {
    (policy, edge): trilane.run(frames=frames, policy=policy, edge=edge, out=place / f"{policy}-{edge}")
    for policy in policies
    for edge in edges
}

# %%
print(f"{'policy':<11} {'edge':<7} {'frame, ms (95 %)':<22} {'p95 latency, ms':>15} {'DSP busy':>9}  error")
for (policy, edge), run in runs.items():
    report = run.report
    times, dsp = report.frame_time_ms, report.units["dsp"]
    low, high = times.mean_low, times.mean_high
    interval = "too short to tell" if low is None or high is None else f"{low:.1f} to {high:.1f}"
    errors = [facts.get("psnr_db_by_band", "no figures") for facts in report.accuracy.values()]
    frame = f"{times.mean:.1f} ({interval})"
    print(f"{policy:<11} {edge:<7} {frame:<22} {report.latency_ms.p95:>15.1f} {dsp.busy:>9.0%}  {errors[0]}")

# %% [markdown]
# What bounded each: the largest part of the frame time.

# %%
for (policy, edge), run in runs.items():
    first = run.explain(slowest=1)["budget"][0]
    print(f"{policy}, {edge}: {first['stage']} ({first['what']}) {first['share']:.0%} of the frame time")

# %% [markdown]
# A plot, where Matplotlib is installed (the extra `plot`).

# %%
try:
    from matplotlib.figure import Figure
except ImportError:
    print("no plot: Matplotlib is not installed")
else:
    figure = Figure(figsize=(7, 4))
    axes = figure.subplots()
    for (policy, edge), run in runs.items():
        shown = run.frames()
        axes.plot(shown["frame"][1:], shown["frame_ns"][1:] / 1e6, label=f"{policy}, {edge}")
    axes.set(xlabel="frame", ylabel="frame time, ms")
    axes.legend()
    figure.savefig(place / "frame-times.png")
    print("plot:", place / "frame-times.png")
