"""Training of an avatar (optional extra: PyTorch)."""
