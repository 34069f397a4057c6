"""Feed and weigh buckets by name, as TOML: what of a scene is theirs."""
