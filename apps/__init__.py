"""Programs around the pipeline, with one folder for each task of a user, such as `run`, `compare` or `watch`.

`interface` is for programs and notebooks, `cli` for the command line; both build on the other folders. apps/ may import
every folder. No other folder imports apps/.
"""
