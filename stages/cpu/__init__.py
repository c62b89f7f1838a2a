"""The CPU unit: pose, crop and present."""
