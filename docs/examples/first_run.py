"""A run, a look at it, and where its time went: a notebook as a script (cells begin with `# %%`)."""

# %% [markdown]
# A run of the default scene. `FRAMES=20 python first_run.py` is a short one; `OUT` is the run folder.

# %%
import os

import trilane

frames = int(os.environ.get("FRAMES", "120"))
run = trilane.run(frames=frames, out=os.environ.get("OUT"))
run  # noqa: B018 - a notebook shows it as a table, the error beside the speed

# %%
report = run.report
print(run)
print(f"rate {report.fps:.1f} frames a second on {report.machine.cpu.model}, measured")
for name, facts in report.accuracy.items():
    print(f"error of {name}:", facts.get("psnr_db_by_band", facts.get("why")))

# %% [markdown]
# What bounded the frame time: the rows sum to it.

# %%
found = run.explain(slowest=3)
for row in found["budget"][:5]:
    print(f"{row['stage']:>10} {row['what']:<10} {row['ms']:7.2f} ms a frame, {row['share']:.0%}")
for row in found["slowest"]:
    print(f"frame {row['frame']}: {row['frame_ms']:.1f} ms", [reason["text"] for reason in row["why"]])

# %% [markdown]
# Every job is a row of a NumPy array; here, what each stage's jobs waited for.

# %%
jobs = run.jobs
for stage in report.stages:
    own = jobs[jobs["stage"] == stage]
    causes = {
        str(cause): float(own["wait_ns"][own["wait_cause"] == cause].mean()) / 1e6 for cause in set(own["wait_cause"])
    }
    print(f"{stage:>10}: waits by cause, ms:", {cause or "none": round(ms, 2) for cause, ms in causes.items()})
times = run.frames()
print(
    f"slowest frame time {times['frame_ns'].max() / 1e6:.1f} ms, mean latency {times['latency_ns'].mean() / 1e6:.1f} ms"
)
