"""How it runs: Dask graphs, clusters, the command line, the report."""
