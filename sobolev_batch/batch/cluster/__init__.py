"""Cluster: Dask's scheduler and workers, checked, equipped and given tasks.

In: a client and tasks. Out: results, with failures of the cluster told apart from those of a task.
"""
