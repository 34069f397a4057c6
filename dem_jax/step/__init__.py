"""One time step and the loops around it, what is measured, runs side by side."""
