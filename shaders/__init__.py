"""The GLSL sources that the GPU unit and the training draw with.

This folder holds only data, and uses nothing.
"""
