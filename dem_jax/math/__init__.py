"""Vectors, rotations and ordering of long arrays: mathematics without reference to pieces."""
