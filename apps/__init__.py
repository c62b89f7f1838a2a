"""Who uses the pipeline, a folder for each thing that a user does with it.

`interface` is for programs and notebooks, `cli` for the command line; both stand on the other folders. apps/ may use
every other folder; nothing imports it.
"""
