"""Dealing out tasks, so many at a time, and taking back what became of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice

from distributed import Client, Future, as_completed

from sobolev_batch.batch.cluster.outcomes import is_suspect, outcomes
from sobolev_batch.batch.cluster.workers import Workers

# Tasks that the scheduler knows of at a time: enough to deal out well, while each costs it memory.
_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD = 2000, 20


def many_in_flight(crew: Workers) -> int:
    """How many tasks the scheduler may know of at a time where each is small."""
    return max(_LEAST_IN_FLIGHT, _IN_FLIGHT_PER_THREAD * crew.threads)


def deal(
    client: Client, submit: Callable[[int, int], Future], numbers: Sequence[int], in_flight: int
) -> Iterator[tuple[int, object]]:
    """Have tasks done; those that were on workers which died are tried again alone, at the end.

    Args:
        client: of the cluster.
        submit: hands the task of a number over, given the number and its rank among all that are dealt.
        numbers: of the tasks.
        in_flight: how many the scheduler may know of at a time.

    Yields:
        The number of a task with its result, or with what it raised; that is a `KilledWorker` where the task
        has ended its workers with nothing else beside it.

    Raises:
        ClusterError: the scheduler was lost.
    """
    suspects = []
    for number, outcome in _deal_once(client, submit, numbers, in_flight):
        if is_suspect(outcome):
            suspects.append(number)
        else:
            yield number, outcome
    yield from _deal_once(client, submit, sorted(suspects), 1)


def _deal_once(
    client: Client, submit: Callable[[int, int], Future], numbers: Sequence[int], in_flight: int
) -> Iterator[tuple[int, object]]:
    futures: dict[Future, int] = {}
    remaining = enumerate(numbers)
    completed = as_completed(loop=client.loop)

    def hand_over(count: int) -> None:
        for rank, number in islice(remaining, count):
            future = submit(number, rank)
            futures[future] = number
            completed.add(future)

    try:
        hand_over(in_flight)
        for batch in completed.batches():
            found = outcomes(client, batch)
            yield from zip([futures.pop(future) for future in batch], found, strict=True)
            # Only now: what is dealt with nothing beside it has to be alone.
            hand_over(len(batch))
    finally:
        # A client may outlive this run, and the cluster would go on for it.
        for future in futures:
            future.release()
