"""Batch: a study as tasks on a Dask cluster, over a zarr store.

In: a study and the place of a store. Out: stored fields, norms, distances and convergence tables.
"""
