"""Stock studies, as TOML."""
