"""The avatar's stages, one folder per unit, and what joins them: packets, assets, configuration, the avatar's pipeline.

It may use `scene/`, `avatars/`, `hw_profiles/`, `pipeline/` and the folders below them. This file imports nothing, so
that the fork server can start with the names below before anything slow is imported.
"""

#: Factory of each stage; the parts of the network share one.
FACTORIES = {
    "pose": "trilane.stages.cpu.pose:build",
    "raster": "trilane.stages.gpu.raster:build",
    "infer": "trilane.stages.dsp.infer:build",
    "composite": "trilane.stages.gpu.composite:build",
    "present": "trilane.stages.cpu.present:build",
}
#: Modules that the fork server imports: units then start in milliseconds.
PRELOAD = tuple(factory.partition(":")[0] for factory in FACTORIES.values())
