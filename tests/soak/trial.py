"""A study run twice: undisturbed into a folder, and to the end against all odds into object storage."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.storage.location import Location
from tests.soak.comparison import differences
from tests.soak.havoc import Havoc
from tests.soak.meshes import write_study
from tests.support.object_storage import BUCKET, HEALTHY, Kind, Rule, Server, serving, taken_for_s3

_WORKERS = 2
# Workers and drivers that are killed leave much to say to those that go on.
_QUIET = {"DASK_LOGGING__DISTRIBUTED": "critical"}
_LONGEST_SECONDS = 3600


@dataclass(frozen=True)
class Outcome:
    """What came of a trial.

    Attributes:
        differences: of the stores; there should be none.
        workers, drivers: how many processes were killed.
        failures: of requests, by kind.
        requests: all of them.
        stored_again: fields that were stored more than once.
        clean_seconds, soaked_seconds: how long the runs took.
    """

    differences: tuple[str, ...]
    workers: int
    drivers: int
    failures: Counter[Kind]
    requests: int
    stored_again: int
    clean_seconds: float
    soaked_seconds: float


def soak(folder: Path, meshes: int, seed: int, kills: int, driver_kills: int, rate: float) -> Outcome:
    """Run a study of so many meshes, with kills, and with a share of all requests failing."""
    path = write_study(folder, meshes, seed)
    clean = Location.parse(folder / "clean.zarr")
    soaked = Location.parse(f"s3://{BUCKET}/soaked.zarr")
    with serving(seed) as storage, taken_for_s3({**storage.environment(), **_QUIET}):
        with local_client(_WORKERS) as client:
            started = time.monotonic()
            run(Study.from_toml(path), clean, client)
            clean_seconds = time.monotonic() - started
            nannies = client.cluster.workers
            # Each mesh takes a look at its record before anything is computed, then its field and its record are
            # written, its field is read. There are some more requests at the beginning and at the end, so that all
            # kills come.
            havoc = Havoc(
                seed,
                range(meshes, 4 * meshes),
                kills,
                driver_kills,
                lambda: [nanny.pid or 0 for nanny in nannies.values()],
                lambda: len(client.cluster.scheduler.workers),
            )
            storage.listener = havoc.on_request
            storage.rule = Rule(rate)
            started = time.monotonic()
            _drive(path, soaked, client.scheduler.address, havoc)
            soaked_seconds = time.monotonic() - started
        storage.rule = HEALTHY
        made = storage.requests()
        return Outcome(
            tuple(differences(soaked, clean)),
            havoc.workers,
            havoc.drivers,
            storage.failures(),
            len(made),
            _stored_again(storage),
            clean_seconds,
            soaked_seconds,
        )


def _drive(study: Path, store: Location, scheduler: str, havoc: Havoc) -> None:
    """Give the same command again until it has ended by itself.

    Raises:
        RuntimeError: it has ended badly by itself.
    """
    command = [sys.executable, "-m", "sobolev_batch", "run", str(study), "--store", str(store)]
    while True:
        driver = subprocess.Popen(
            [*command, "--scheduler", scheduler], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        havoc.drive(driver)
        _, errors = driver.communicate(timeout=_LONGEST_SECONDS)
        if driver.returncode == 0:
            return
        if driver.returncode != -signal.SIGKILL:
            raise RuntimeError(f"the run has ended with status {driver.returncode}:\n{errors[-4000:]}")


def _stored_again(storage: Server) -> int:
    stored = [
        request.path
        for request in storage.requests()
        if request.method == "PUT" and "/fourier/fourier/c/" in request.path and request.failure is None
    ]
    return len(stored) - len(set(stored))
