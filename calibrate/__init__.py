"""Calibration of the Product Model to traces of the discrete element method."""
