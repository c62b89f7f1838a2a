"""The programs around the pipeline, with a folder for each thing that a user does.

`interface` is for programs and notebooks, `cli` for the command line; both build on the other folders. apps/ may import
every folder. No other folder imports apps/.
"""
