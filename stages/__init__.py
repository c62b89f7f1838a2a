"""The avatar's stages, one folder per unit, with their packets, assets, configuration and pipeline.

This folder may use `scene/`, `avatars/`, `hw_profiles/`, `pipeline/` and the layers below them. This file imports
nothing, so that the fork server reads the names below without waiting for a slow import.
"""

#: Factory of each stage. If the network is cut, each part is a stage with the factory of `infer`.
FACTORIES = {
    "pose": "trilane.stages.cpu.pose:build",
    "raster": "trilane.stages.gpu.raster:build",
    "infer": "trilane.stages.dsp.infer:build",
    "composite": "trilane.stages.gpu.composite:build",
    "present": "trilane.stages.cpu.present:build",
}
#: Modules that the fork server imports, so that units start in milliseconds.
PRELOAD = tuple(factory.partition(":")[0] for factory in FACTORIES.values())
