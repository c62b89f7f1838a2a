"""Avatar bundles on disk, and how they are made."""
