"""A run on a cluster whose processes are killed and stopped in random order, while fields of its store trade places.

Its storage may fail now and then. Schedulers and nannies that ended are started again, as a batch system does it, and
so is a command that ended badly.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from sobolev_batch import Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.store.location import Location
from tests.soak.studies import write_study
from tests.support.commands import COMMAND
from tests.support.object_storage import BUCKET, HEALTHY, Rule, Server, serving, taken_for_s3
from tests.support.processes import free_port
from tests.support.stores import differences

SIGNALS = {"killed": signal.SIGKILL, "stopped": signal.SIGSTOP}
ROLES = ("worker", "nanny", "scheduler", "driver")
# Fields of two meshes trade places.
EXCHANGED = ("chunks", "exchanged")
_WORKERS = 2
_POLL_SECONDS = 0.1
# Whoever is silent is given up after this time.
_IMPATIENT = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "10s"}
_LONGEST_SECONDS = 3600.0


@dataclass(frozen=True)
class Strike:
    """What happens to which role once some number of meshes are complete."""

    complete: int
    role: str
    what: str


@dataclass(frozen=True)
class Outcome:
    """The strikes that came before a run had ended, and how its store then differs from that of an undisturbed run."""

    strikes: tuple[Strike, ...]
    seconds: float
    commands: int
    failures: Counter[str]
    differences: tuple[str, ...]


def strikes_of(seed: int, count: int, meshes: int) -> tuple[Strike, ...]:
    chance = random.Random(seed)
    kinds = [(role, what) for role in ROLES for what in SIGNALS] + [EXCHANGED]
    moments = sorted(chance.choices(range(meshes + 1), k=count))
    return tuple(Strike(complete, *chance.choice(kinds)) for complete in moments)


def strike_all(
    folder: Path, plans: Mapping[int, tuple[Strike, ...]], meshes: int, rate: float = 0.0
) -> Iterator[Outcome]:
    """Yield what comes of each plan, whose key chooses its victims; a rate of failing requests needs object storage."""
    study = write_study(folder, meshes)
    clean = Location.parse(folder / "clean.zarr")
    with local_client(_WORKERS) as client:
        run(Study.from_toml(study), clean, client)
    for seed, strikes in plans.items():
        own = folder / f"seed-{seed}"
        own.mkdir()
        with ExitStack() as stack:
            store, server = Location.parse(own / "struck.zarr"), None
            if rate:
                server = stack.enter_context(serving(seed))
                stack.enter_context(taken_for_s3(server.environment()))
                store = Location.parse(f"s3://{BUCKET}/struck.zarr")
                server.obey(Rule(rate))
            yield _strike(_Run(study, store, own), clean, seed, strikes, server)


def _strike(struck: _Run, clean: Location, seed: int, strikes: tuple[Strike, ...], server: Server | None) -> Outcome:
    due, chance, started = list(strikes), random.Random(seed), time.monotonic()
    try:
        while not struck.is_done:
            assert time.monotonic() - started < _LONGEST_SECONDS, f"seed {seed}: the run has not ended"
            time.sleep(_POLL_SECONDS)
            struck.revive()
            rows = sorted(struck.store.sizes("records/record/c"))
            if due and len(rows) >= due[0].complete and struck.suffer(due[0], rows, chance):
                due.pop(0)
    finally:
        struck.end()
    seconds, failures = time.monotonic() - started, Counter[str]()
    if server is not None:
        server.obey(HEALTHY)
        failures = Counter(map(str, server.failures().elements()))
    came = strikes[: len(strikes) - len(due)]
    return Outcome(
        came, seconds, struck.commands, failures, tuple(differences(open_store(struck.store), open_store(clean)))
    )


class _Run:
    """A scheduler, workers with nannies, and the command that carries out the study on them, all of them processes.

    It is done once the study is computed, and verified.
    """

    def __init__(self, study: Path, store: Location, folder: Path) -> None:
        self.store, self.is_done, self.commands = store, False, 0
        self._study, self._folder, self._starts = study, folder, 0
        self._port = str(free_port())
        self._scheduler = self._start_scheduler()
        self._nannies = [self._start_nanny() for _ in range(_WORKERS)]
        self._driver = self._start_driver()

    def suffer(self, strike: Strike, rows: list[str], chance: random.Random) -> bool:
        """Return whether a strike came: its victim may not be there yet."""
        if (strike.role, strike.what) == EXCHANGED:
            if len(rows) < 2:
                return False
            names = [f"fourier/fourier/c/{row.rpartition('/')[2]}/0/0/0" for row in chance.sample(rows, 2)]
            contents = [self.store.read(name) or b"" for name in names]
            self.store.write(dict(zip(names, reversed(contents), strict=True)))
            return True
        processes = {
            "driver": [self._driver],
            "scheduler": [self._scheduler],
            "nanny": self._nannies,
            "worker": [worker for nanny in self._nannies for worker in _workers_of(nanny)],
        }
        victims = [process for process in processes[strike.role] if _is_running(process)]
        if victims:
            chance.choice(victims).send_signal(SIGNALS[strike.what])
        return bool(victims)

    def revive(self) -> None:
        """Start again what has ended, and do what somebody does who looks at the terminal."""
        if self._scheduler.poll() is not None:
            self._scheduler = self._start_scheduler()
        self._nannies = [nanny if nanny.poll() is None else self._start_nanny() for nanny in self._nannies]
        status = self._driver.poll()
        if status is None:
            # It keeps its lock, so somebody has to continue it, or to kill it.
            if self._driver.status() == psutil.STATUS_STOPPED:
                self._driver.send_signal(signal.SIGCONT)
        elif status == 0 and self._is_verified():
            self.is_done = True
        else:
            # The command has told that the scheduler is lost, or that there is no worker: people kill what is stopped.
            for process in (self._scheduler, *self._nannies):
                if not all(map(_is_running, [process, *_workers_of(process)])):
                    _kill(process)
            self._driver = self._start_driver()

    def end(self) -> None:
        for process in (self._driver, self._scheduler, *self._nannies):
            _kill(process)

    def _is_verified(self) -> bool:
        return subprocess.run([*COMMAND, "verify", str(self.store)], capture_output=True).returncode == 0

    def _start_driver(self) -> psutil.Popen:
        self.commands += 1
        options = ["--store", str(self.store), "--scheduler", f"tcp://127.0.0.1:{self._port}"]
        return self._start([*COMMAND, "run", str(self._study), *options])

    def _start_scheduler(self) -> psutil.Popen:
        return self._start_dask("scheduler", "--port", self._port)

    def _start_nanny(self) -> psutil.Popen:
        scheduler = f"tcp://127.0.0.1:{self._port}"
        return self._start_dask("worker", scheduler, "--nthreads", "1", "--local-directory", str(self._folder))

    def _start_dask(self, *arguments: str) -> psutil.Popen:
        loopback = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
        return self._start([sys.executable, "-m", "dask", *arguments, *loopback])

    def _start(self, command: list[str]) -> psutil.Popen:
        self._starts += 1
        with (self._folder / f"{self._starts}.log").open("w") as log:
            return psutil.Popen(command, stdout=log, stderr=subprocess.STDOUT, env={**os.environ, **_IMPATIENT})


def _kill(process: psutil.Popen) -> None:
    family = [process]
    with suppress(psutil.NoSuchProcess):
        family = [*process.children(recursive=True), process]
    for one in family:
        with suppress(psutil.NoSuchProcess):
            one.kill()
    process.wait()


def _is_running(process: psutil.Process) -> bool:
    try:
        return process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD, psutil.STATUS_STOPPED)
    except psutil.NoSuchProcess:
        return False


def _workers_of(nanny: psutil.Popen) -> list[psutil.Process]:
    """Return the process of a nanny's worker: the other one that it has tracks resources."""
    try:
        return [one for one in nanny.children() if any("spawn_main" in part for part in one.cmdline())]
    except psutil.NoSuchProcess:
        return []
