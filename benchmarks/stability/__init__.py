"""Stress tests of numerical stability, too long for the tests: run by hand, each prints what it
found.
"""
