"""Walls: panels, their prescribed motion, and their kinematics in a time step."""
