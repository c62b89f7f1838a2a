"""The trilane command."""
