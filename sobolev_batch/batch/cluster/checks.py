"""What has to hold on a cluster before a study begins: all processes have the same versions and see the same store."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

from distributed import Client

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Lock
from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.errors import ClusterError, StoreError
from sobolev_batch.spectral.transform.transform import NUMERICS_VERSION

_log = logging.getLogger(__name__)

_OF_DASK = ("dask", "distributed")
_OF_NUMBERS = (
    *("cloudpickle", "sobolev-batch", "numpy", "scipy", "finufft", "modepy", "zarr", "xarray"),
    *("fast-simplification", "trimesh", "nibabel", "plyfile"),
)
# Not every study needs these. Processes that have them must have the same.
_OF_EXTRAS = ("pyacvd", "vtk")


def require_same_versions(client: Client, libraries: Iterable[str] = ()) -> None:
    """Check that the scheduler and all workers have installed what this process has.

    Args:
        client: Client of the cluster.
        libraries: Names of distributions that the study takes besides what this package requires.

    Raises:
        ClusterError: They differ; the message names the processes and both versions.
    """
    required = (*_OF_DASK, *_OF_NUMBERS, *libraries)
    # Dask answers this itself: code of ours would not run where the package is missing.
    answers = client.get_versions(packages=[*required, *_OF_EXTRAS])
    ours = _packages(answers["client"])
    differences = _differences(
        ours, {f"scheduler {client.scheduler.address}": _packages(answers["scheduler"])}, _OF_DASK
    )
    # A worker that is just leaving answers nothing.
    workers = {f"worker {address}": _packages(answer) for address, answer in answers["workers"].items() if answer}
    differences += _differences(ours, workers, ("python", *required))
    for name in filter(ours.get, _OF_EXTRAS):
        differences += _differences(ours, {who: found for who, found in workers.items() if found[name]}, [name])
    if not differences:
        # One checkout may follow another without a new version.
        replies = client.run(_checkout, on_error="return")
        workers = {f"worker {address}": reply for address, reply in replies.items() if isinstance(reply, dict)}
        differences = _differences(_checkout(), workers, _checkout())
    if differences:
        raise ClusterError(
            f"versions differ, and results would mix what they compute: {'; '.join(dict.fromkeys(differences))}. "
            "Install the same ones everywhere and start those processes again"
        )


def _packages(answer: Mapping[str, Mapping[str, str | None]]) -> dict[str, str]:
    versions = {name: version or "" for name, version in answer["packages"].items()}
    return {**versions, "python": ".".join(versions["python"].split(".")[:2])}


def _checkout() -> dict[str, str]:
    return {"numerics of sobolev-batch": str(NUMERICS_VERSION), "schema of sobolev-batch": str(SCHEMA_VERSION)}


def _differences(ours: Mapping[str, str], theirs: Mapping[str, Mapping[str, str]], names: Iterable[str]) -> list[str]:
    """Describe each version other than ours, and who has it."""
    described = []
    for name in names:
        for version in sorted({versions[name] for versions in theirs.values()} - {ours[name]}):
            first, *others = sorted(who for who, versions in theirs.items() if versions[name] == version)
            more = f" and {len(others)} more" if others else ""
            here = f"{ours[name]} here" if ours[name] else "there is none here"
            described.append(f"{name} {version or 'is missing'} at the {first}{more}, {here}")
    return described


def require_store_access(client: Client, location: Location, lock: Lock) -> None:
    """Check that all workers see the store that this process has locked.

    Drivers and credentials differ between processes: a store that this process reaches, a worker may not. And a
    folder of the same name may be another folder on another machine.

    Raises:
        StoreError: A worker does not see it; the message names the worker.
    """
    for worker, problem in client.run(_problem, location, lock, on_error="return").items():
        if isinstance(problem, BaseException):
            # A worker that has just gone says nothing about the store; tasks will tell.
            _log.warning("the worker %s does not say whether it reaches %s: %s", worker, location, problem)
        elif problem and location.is_in_memory:
            raise StoreError(
                f"{location}: what is written there stays in the memory of one process, and the worker {worker} is "
                "another one; name a folder or an s3:// URL, or leave out the client"
            )
        elif problem:
            raise StoreError(f"the worker {worker} cannot use the store: {problem}")


def _problem(location: Location, lock: Lock) -> str:
    """Return why the process that runs this does not see the store; empty if it does."""
    try:
        sees_lock = lock.is_held(location)
    except StoreError as error:
        return str(error)
    return "" if sees_lock else f"{location} is another place there; name one that all machines share"
