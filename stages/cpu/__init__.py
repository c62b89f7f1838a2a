"""The CPU unit: the pose stage, with the crop and the tensor's layout, and the present stage.

This folder may use the modules that all stages share and the layers below `stages/`, but neither `stages/gpu/` nor
`stages/dsp/`.
"""
