"""Batch: the objects of a study side by side as tasks on a Dask cluster, over their store.

In: a study and the place of a store. Out: stored fields and tables, and what became of each mesh.
"""
