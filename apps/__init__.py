"""Who uses the pipeline: the command line, the dashboard, experiments and the run folder.

It may use every other folder; nothing imports it.
"""
