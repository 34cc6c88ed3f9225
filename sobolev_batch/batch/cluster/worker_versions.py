"""Versions of a process, asked of workers that may lack this package.

This module travels to workers by value, so that a worker without this package, or with another one, can run it.
Hence it imports nothing of the package at its top.
"""

from __future__ import annotations

import logging
import pickle
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
from distributed import WorkerPlugin

Versions = Mapping[str, str]  # by name, empty where it is not installed

OF_DASK = ("dask", "distributed", "cloudpickle")
_OF_NUMBERS = (
    *("sobolev-batch", "numpy", "scipy", "finufft", "modepy", "zarr", "xarray"),
    *("fast-simplification", "trimesh", "nibabel", "plyfile"),
)
# Not every study needs these; where two processes have them, they must be the same.
_OF_EXTRAS = ("pyacvd", "vtk")


def installed_versions(libraries: Sequence[str] = ()) -> Versions:
    """Return the versions of the process that calls this.

    Args:
        libraries: Names of distributions that a study takes besides what this package requires.
    """
    versions = {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}
    for name in dict.fromkeys((*OF_DASK, *_OF_NUMBERS, *_OF_EXTRAS, *libraries)):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = ""
    # One checkout may follow another without a new version.
    numerics = schema = ""
    try:
        from sobolev_batch.batch.store.metadata import SCHEMA_VERSION
        from sobolev_batch.spectral.transform.transform import NUMERICS_VERSION

        numerics, schema = str(NUMERICS_VERSION), str(SCHEMA_VERSION)
    except ImportError:
        # It says that it is installed, and cannot be used.
        versions["sobolev-batch"] = ""
    return {**versions, "numerics of sobolev-batch": numerics, "schema of sobolev-batch": schema}


def differing(expected: Versions, versions: Versions, libraries: Sequence[str] = ()) -> list[str]:
    """Return the names of the versions in which a process differs from what is expected."""
    optional = set(_OF_EXTRAS) - set(libraries)
    return [
        name
        for name, version in expected.items()
        if versions[name] != version and not (name in optional and "" in (version, versions[name]))
    ]


class VersionGuard(WorkerPlugin):  # type: ignore[misc]  # distributed has no types
    """Plugin that installs another plugin on workers with the versions of this process, and ends other workers.

    Dask sets it up on workers that join later too, before they run any task. A worker that differs retires: its
    tasks go elsewhere, and count as failures of nothing.
    """

    idempotent = True

    def __init__(self, plugin: WorkerPlugin, name: str) -> None:
        """Take the plugin to install and its name."""
        self._expected = installed_versions()
        self._plugin, self._name = pickle.dumps(plugin), name

    async def setup(self, worker: Any) -> None:
        """Install the plugin, or end the worker."""
        versions = installed_versions()
        names = differing(self._expected, versions)
        if names:
            logging.getLogger("distributed.worker").error(
                "this worker may not join: it has %s; install the same versions here, or restart the scheduler "
                "where all others are new",
                ", ".join(
                    f"{name} {versions[name] or 'missing'}, and the study {self._expected[name]}" for name in names
                ),
            )
            await worker.scheduler.retire_workers(
                workers=[worker.address], close_workers=False, remove=True, stimulus_id="sobolev-batch-versions"
            )
            # An exception would be logged, and the worker would take tasks all the same.
            raise SystemExit(1)
        await worker.plugin_add(plugin=self._plugin, name=self._name)


cloudpickle.register_pickle_by_value(sys.modules[__name__])
