"""One application on several chips, predicted: a notebook as a script (cells begin with `# %%`)."""

# %% [markdown]
# The reference network (ResNet-18 encoder, 512 x 512, 16 channels) on the DSP of four chips, pipelined. Every figure is
# computed; the interval says where the frame time is with a probability of 80 %.

# %%
import trilane

CHIPS = ("snapdragon-865", "snapdragon-888", "snapdragon-8-gen-2", "snapdragon-8-gen-3")
predictions = {chip: trilane.predict(chip, policy="pipelined", edge="double") for chip in CHIPS}

# %%
print(f"{'chip':<20} {'frame, ms (80 %)':<22} {'latency, ms':>11} {'DSP busy':>9} {'power, W':>9}")
for chip, predicted in predictions.items():
    frame = f"{predicted.frame_ms:.1f} ({predicted.low_ms:.1f} to {predicted.high_ms:.1f})"
    note = "  as fast as the display shows" if predicted.is_display_capped else ""
    busy = predicted.units["dsp"]["busy"]
    print(f"{chip:<20} {frame:<22} {predicted.latency_ms:>11.1f} {busy:>9.0%} {predicted.power_w:>9.1f}{note}")

# %% [markdown]
# A notebook shows one prediction as a table.

# %%
predictions["snapdragon-888"]
