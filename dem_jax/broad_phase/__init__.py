"""Broad phase: search for candidate pairs, rebuild, contact history carried across it, capacities."""
