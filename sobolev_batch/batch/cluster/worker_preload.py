"""Preload of workers of a local cluster, whose messages go to the terminal of the driver."""

from __future__ import annotations

import logging

from distributed import Worker

from sobolev_batch.visible import make_messages_visible


def dask_setup(worker: Worker) -> None:
    """Make messages of this worker visible, and leave out Dask's: the driver tells what went wrong.

    Dask calls this when the worker starts.
    """
    make_messages_visible()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
