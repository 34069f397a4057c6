"""Benchmarks: ``python -m benchmarks.NAME``; tables with load, versions and compile time go to
benchmarks/results/.
"""
