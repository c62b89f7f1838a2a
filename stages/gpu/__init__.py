"""The GPU unit: raster and composite."""
