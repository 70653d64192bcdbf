"""A city's junctions as tasks of one graph of Dask's: what a task does, how they are cut and joined, where they run."""
