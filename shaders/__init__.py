"""The GLSL sources that the GPU unit and the training draw with.

It holds data only and uses nothing.
"""
