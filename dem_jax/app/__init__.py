"""The local web app: the command line by clicks, started with ``dem-jax app`` (extra ``app``)."""
