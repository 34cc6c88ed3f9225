"""Cluster: Dask's scheduler and workers, checked, equipped and given tasks.

In: a client and tasks. Out: results, with failures of the cluster told apart from those of a task.
"""

# Seconds of silence after which a worker, or the scheduler, is given up. Here, since the command line needs them before
# it imports anything of Dask.
GIVE_UP_AFTER = 180.0
LEAST_GIVE_UP_AFTER = 10.0
