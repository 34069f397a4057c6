"""The host: a scene becomes a run, chunk by chunk, and nothing that goes wrong passes unseen."""
