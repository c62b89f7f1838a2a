"""The `trilane` command: the modules of its commands, their shared options, and their output.

It may use every folder. A module imports slow packages only when its command runs.
"""
