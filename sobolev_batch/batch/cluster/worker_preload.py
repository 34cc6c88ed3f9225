"""Loaded into the workers of a local cluster: they leave it to the driver to say what went wrong.

What goes wrong in a task is told by its record; of the end of a cluster workers log much that helps nobody.
"""

from __future__ import annotations

import logging

from distributed import Worker


def dask_setup(worker: Worker) -> None:
    """What Dask calls when a worker starts."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
