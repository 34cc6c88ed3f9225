"""Outcomes: what became of tasks, with what is the scheduler's told apart from what is theirs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from distributed import CancelledError, Client, Future
from distributed.comm import CommClosedError
from distributed.scheduler import KilledWorker

from sobolev_batch.errors import ClusterError

# Why a mesh failed whose tasks have ended their workers, with nothing else beside them.
DEADLY = (
    "its tasks ended the worker that they ran on again and again, at last with nothing else beside them, as "
    "happens for want of memory ({}); start workers with more memory, or take it out of the study"
)


def outcomes(client: Client, futures: Sequence[Future]) -> list[Any]:
    """The results of futures that have ended, or what they raised, all fetched at once.

    Raises:
        ClusterError: the scheduler is gone, and what became of its tasks is not known.
    """
    lost = f"the scheduler at {client.scheduler.address} was lost; the same command goes on from what is stored"
    if client.status != "running" or any(future.cancelled() for future in futures):
        raise ClusterError(lost)
    try:
        found = iter(client.gather([future for future in futures if future.status == "finished"]))
        return [next(found) if future.status == "finished" else future.exception() for future in futures]
    except (CommClosedError, CancelledError) as error:
        raise ClusterError(lost) from error


def is_suspect(outcome: Any) -> bool:
    """Whether a task was on workers that died, so often that the scheduler has given it up.

    It need not be what killed them: another task beside it may have been. Alone, it shows.
    """
    return isinstance(outcome, KilledWorker)
