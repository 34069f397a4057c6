"""Stock scenes, as TOML."""
