"""Narrow phase: depth, normal and contact point of two bodies that may touch."""
