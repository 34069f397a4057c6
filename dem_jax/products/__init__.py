"""Products by name, as TOML: what of a scene is theirs."""
