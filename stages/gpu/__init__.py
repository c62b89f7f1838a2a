"""The GPU unit: the raster stage, which fills the network's input, and the composite stage, which draws the frame.

This folder may use `scene/crop.py`, the modules that all stages share, and the layers below `stages/`.
"""
