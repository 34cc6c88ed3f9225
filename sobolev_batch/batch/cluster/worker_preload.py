"""Preload of workers of a local cluster: the driver tells what went wrong, so that they need not log it."""

from __future__ import annotations

import logging

from distributed import Worker


def dask_setup(worker: Worker) -> None:
    """Silence Dask's logs of this worker. Dask calls this when the worker starts."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
