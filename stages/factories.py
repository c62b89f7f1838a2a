"""Which function makes each of the avatar's stages. Rule: names alone; nothing is imported here."""

from __future__ import annotations

#: Stage to its factory; the parts of the network share one.
FACTORIES = {
    "pose": "trilane.stages.cpu.pose:build",
    "raster": "trilane.stages.gpu.raster:build",
    "infer": "trilane.stages.dsp.infer:build",
    "composite": "trilane.stages.gpu.composite:build",
    "present": "trilane.stages.cpu.present:build",
}
#: What the fork server imports: units then start in milliseconds.
PRELOAD = tuple(factory.partition(":")[0] for factory in FACTORIES.values())
