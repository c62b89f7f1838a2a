"""The profiling dashboard."""
