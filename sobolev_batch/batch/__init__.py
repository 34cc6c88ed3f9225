"""Batch: a study as tasks on a Dask cluster, stage after stage, over its store.

In: a study and the place of a store. Out: stored fields and tables, and what became of each mesh.
"""
