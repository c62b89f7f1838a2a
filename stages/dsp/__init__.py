"""The DSP unit: the infer stage, which runs the INT8 network or a part of it, and the runtimes that it can use.

This folder may use the modules that all stages share and the layers below `stages/`, but neither `stages/cpu/` nor
`stages/gpu/`.
"""
