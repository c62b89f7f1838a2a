"""The `trilane` command: a module for a command or a few small ones, options that commands share, what they print with.

It may use every folder; a module imports what is slow to import only when its command runs.
"""
