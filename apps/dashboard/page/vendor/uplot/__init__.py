"""uPlot 1.6.32 (https://github.com/leeoniya/uPlot), MIT License: charts on a canvas."""
