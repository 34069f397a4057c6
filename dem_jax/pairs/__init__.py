"""Which pairs may touch: search, rebuild, history carried across it, room for all of it."""
