"""The `trilane` command: one module per command, options that commands share, and what they print with.

It may use every folder; a module imports what is slow to import only when its command runs.
"""
