"""Where the time of a run went: why jobs waited, which path bounds the frame time, why frames were slow."""
