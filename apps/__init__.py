"""Who uses the pipeline: command line, dashboard, experiments."""
