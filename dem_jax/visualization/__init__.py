"""Figures, animations, exports and the summary of a run."""
