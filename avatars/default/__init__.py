"""The embedded default avatar (data)."""
