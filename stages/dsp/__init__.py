"""The DSP unit: inference of the INT8 network."""
