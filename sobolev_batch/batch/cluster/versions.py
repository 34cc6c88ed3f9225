"""Versions of client, scheduler and workers, which must agree: results would mix what they compute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from distributed import Client

from sobolev_batch.batch.cluster.worker_versions import OF_DASK, Versions, differing, installed_versions
from sobolev_batch.errors import ClusterError

_OF_SCHEDULER = ("dask", "distributed")
_MOST_NAMED = 4


def require_same_versions(client: Client, libraries: Iterable[str] = ()) -> None:
    """Check that the scheduler and all workers have installed what this process has.

    Args:
        client: Client of the cluster.
        libraries: Names of distributions that the study takes besides what this package requires.

    Raises:
        ClusterError: They differ; the message names the processes and both versions.
    """
    # Code cannot travel between Python versions, so that Dask itself is asked for those first.
    answers = client.get_versions()
    ours = _of_dask(answers["client"])
    scheduler = {client.scheduler.address: _of_dask(answers["scheduler"])}
    differences = [*_differences("the scheduler", ours, scheduler, _OF_SCHEDULER)]
    # A worker that is just leaving answers nothing.
    workers = {address: _of_dask(answer) for address, answer in answers["workers"].items() if answer}
    differences += _differences("the worker", ours, workers, ("python", *OF_DASK))
    if not differences:
        libraries = tuple(libraries)
        ours, replies = installed_versions(libraries), client.run(installed_versions, libraries, on_error="return")
        workers = {address: reply for address, reply in replies.items() if isinstance(reply, dict)}
        names = dict.fromkeys(name for theirs in workers.values() for name in differing(ours, theirs, libraries))
        differences += _differences("the worker", ours, workers, names)
    if differences:
        raise ClusterError(
            f"versions differ, and results would mix what they compute: {'; '.join(differences)}. "
            "Install the same ones everywhere and start those processes again"
        )


def _of_dask(answer: Mapping[str, Any]) -> Versions:
    """Return the versions in an answer of Dask's own."""
    versions = {name: str(answer["packages"].get(name) or "") for name in ("python", *OF_DASK)}
    return {**versions, "python": ".".join(versions["python"].split(".")[:2])}


def _differences(who: str, ours: Versions, theirs: Mapping[str, Versions], names: Iterable[str]) -> Iterator[str]:
    """Describe each version other than ours, and who has it."""
    for name in names:
        for version in sorted({versions[name] for versions in theirs.values()} - {ours[name]}):
            at = sorted(address for address, versions in theirs.items() if versions[name] == version)
            more = f" and {len(at) - _MOST_NAMED} more" if len(at) > _MOST_NAMED else ""
            here = f"{ours[name]} here" if ours[name] else "there is none here"
            yield f"{name} {version or 'is missing'} at {who} {', '.join(at[:_MOST_NAMED])}{more}, {here}"
