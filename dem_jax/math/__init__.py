"""Vectors, rotations and the ordering of long arrays: mathematics that knows nothing of pieces."""
