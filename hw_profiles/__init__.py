"""Hardware profiles, the cost model and the thermal model."""
