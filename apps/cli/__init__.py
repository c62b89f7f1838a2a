"""The `trilane` command: the modules of its commands, their shared options, and their output.

This folder may import every folder. A module imports slow packages only when its command runs.
"""
