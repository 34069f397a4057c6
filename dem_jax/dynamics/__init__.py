"""One time step and the loops around it, measured quantities, batched runs."""
