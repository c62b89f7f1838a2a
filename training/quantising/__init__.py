"""From a float network to the integer network that the DSP runs: calibration, scales, equalisation."""
