"""Tasks of studies and ensembles: computed here, by workers of Dask, or as shards of a job array."""
