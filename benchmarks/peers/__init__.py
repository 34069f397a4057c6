"""The same packed box with other programs: a module for each, found on PATH, its input made here
from the same poses.
"""
