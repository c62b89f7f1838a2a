"""Who uses the pipeline: the command line, experiments, what a run writes into its folder.

It may use every other folder; nothing imports it.
"""
