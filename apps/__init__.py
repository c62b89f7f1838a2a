"""The programs around the pipeline, with a folder for each thing that a user does.

`interface` is for programs and notebooks, `cli` for the command line; both use the other parts of apps/. This folder
may import from every other folder, and no other folder imports from it.
"""
