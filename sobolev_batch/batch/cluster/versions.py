"""Versions: what client, scheduler and workers have installed must agree, or the numbers would mix.

What asks a worker travels by value, as nested functions and classes do: a worker that lacks this package,
or has another one, has to be able to answer. Code cannot travel between Python versions, so that Dask itself
is asked for those first.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from distributed import Client, WorkerPlugin

from sobolev_batch.errors import ClusterError

Versions = Mapping[str, str]  # by name, empty where it is not installed

_OF_SCHEDULER = ("dask", "distributed")
_OF_DASK = ("python", *_OF_SCHEDULER, "cloudpickle")
_OF_NUMBERS = (
    *("sobolev-batch", "numpy", "scipy", "finufft", "modepy", "zarr", "xarray"),
    *("fast-simplification", "trimesh", "nibabel", "plyfile"),
)
# Not every study needs these; whoever has them must have the same.
_OF_EXTRAS = ("pyacvd", "vtk")
_MOST_NAMED = 4


def require_same_versions(client: Client, needed: Iterable[str] = ()) -> None:
    """Check that the scheduler and all workers have installed what this process has.

    Args:
        client: of the cluster.
        needed: names of distributions that the study takes besides what this package requires.

    Raises:
        ClusterError: they differ; the message tells where, and what is there and here.
    """
    answers = client.get_versions()
    ours = _of_dask(answers["client"])
    scheduler = {client.scheduler.address: _of_dask(answers["scheduler"])}
    differences = [*_differences("the scheduler", ours, scheduler, _OF_SCHEDULER)]
    # Of a worker that is just leaving there is nothing.
    workers = {address: _of_dask(answer) for address, answer in answers["workers"].items() if answer}
    differences += _differences("the worker", ours, workers, _OF_DASK)
    if not differences:
        needed = tuple(needed)
        ask, differing = _asker(needed), _comparison(needed)
        ours, found = ask(), client.run(ask, on_error="return")
        workers = {address: answer for address, answer in found.items() if isinstance(answer, dict)}
        names = dict.fromkeys(name for theirs in workers.values() for name in differing(ours, theirs))
        differences += _differences("the worker", ours, workers, tuple(names))
    if differences:
        raise ClusterError(
            f"versions differ, and results would mix what they compute: {'; '.join(differences)}. "
            "Install the same ones everywhere and start those processes again"
        )


def guarded(plugin: WorkerPlugin, name: str) -> WorkerPlugin:
    """A plugin that puts another one in place on workers with the versions of this process, and ends others.

    Dask calls it on workers that join later too, before they run any task. One that differs retires: what the
    scheduler had meant for it goes elsewhere, and counts as a failure of nothing.
    """
    ask, differing = _asker(), _comparison()
    expected, admitted = ask(), pickle.dumps(plugin)

    class Guard(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
        idempotent = True

        async def setup(self, worker: Any) -> None:
            import logging

            found = ask()
            names = differing(expected, found)
            if names:
                logging.getLogger("distributed.worker").error(
                    "this worker may not join: it has %s; install the same versions here, or restart the scheduler "
                    "where all others are new",
                    ", ".join(f"{name} {found[name] or 'missing'}, and the study {expected[name]}" for name in names),
                )
                await worker.scheduler.retire_workers(
                    workers=[worker.address], close_workers=False, remove=True, stimulus_id="sobolev-batch-versions"
                )
                # An exception would be logged, and tasks be taken all the same.
                raise SystemExit(1)
            await worker.plugin_add(plugin=admitted, name=name)

    return Guard()


def _asker(needed: Sequence[str] = ()) -> Callable[[], Versions]:
    """What tells the versions of the process that calls it."""
    packages = tuple(dict.fromkeys((*_OF_DASK[1:], *_OF_NUMBERS, *_OF_EXTRAS, *needed)))

    def ask() -> Versions:
        import sys
        from importlib import metadata

        found = {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}
        for name in packages:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                found[name] = ""
        # One checkout may follow another without a new version.
        numerics = schema = ""
        try:
            from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
            from sobolev_batch.spectral.transform.transform import NUMERICS_VERSION

            numerics, schema = str(NUMERICS_VERSION), str(SCHEMA_VERSION)
        except ImportError:
            # It says that it is installed, and cannot be used.
            found["sobolev-batch"] = ""
        return {**found, "numerics of sobolev-batch": numerics, "schema of sobolev-batch": schema}

    return ask


def _comparison(needed: Sequence[str] = ()) -> Callable[[Versions, Versions], list[str]]:
    """What names the versions in which a worker differs from what is expected."""
    loose = tuple(name for name in _OF_EXTRAS if name not in needed)

    def differing(expected: Versions, found: Versions) -> list[str]:
        return [
            name
            for name, version in expected.items()
            if found[name] != version and not (name in loose and "" in (version, found[name]))
        ]

    return differing


def _of_dask(answer: Mapping[str, Any]) -> Versions:
    """What Dask's own answer says of some packages."""
    found = {name: str(answer["packages"].get(name) or "") for name in _OF_DASK}
    return {**found, "python": ".".join(found["python"].split(".")[:2])}


def _differences(who: str, ours: Versions, theirs: Mapping[str, Versions], names: Iterable[str]) -> Iterator[str]:
    """In words: for each name and each version other than ours, who has it."""
    for name in names:
        for version in sorted({found[name] for found in theirs.values()} - {ours[name]}):
            at = sorted(address for address, found in theirs.items() if found[name] == version)
            more = f" and {len(at) - _MOST_NAMED} more" if len(at) > _MOST_NAMED else ""
            here = f"{ours[name]} here" if ours[name] else "there is none here"
            yield f"{name} {version or 'is missing'} at {who} {', '.join(at[:_MOST_NAMED])}{more}, {here}"
