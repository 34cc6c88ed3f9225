"""A run on a cluster whose processes are killed and stopped in random order, while chunks of its store trade places.

Schedulers and nannies that ended are started again, as a batch system does it, and so is a command that ended badly.
"""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.batch.storage.location import Location
from tests.soak.comparison import differences
from tests.soak.meshes import write_study
from tests.support.commands import COMMAND

WORKERS = 2
SIGNALS = {"killed": signal.SIGKILL, "stopped": signal.SIGSTOP}
ROLES = ("worker", "nanny", "scheduler", "driver")
# Fields of two meshes trade places.
EXCHANGED = ("chunks", "exchanged")
_POLL_SECONDS = 0.1
# A stopped driver keeps its lock, so somebody has to continue it, or to kill it.
_STOPPED_DRIVER_SECONDS = 3.0
_LONGEST_SECONDS = 1800.0
MESHES = 60


@dataclass(frozen=True)
class Strike:
    """What happens once so many meshes are complete.

    Attributes:
        complete: Number of complete meshes.
        role: What it happens to.
        what: What happens.
    """

    complete: int
    role: str
    what: str


def strikes_of(seed: int, count: int) -> tuple[Strike, ...]:
    """Return some strikes at random, in the order of their moments."""
    chance = random.Random(seed)
    kinds = [(role, what) for role in ROLES for what in SIGNALS] + [EXCHANGED]
    return tuple(
        Strike(complete, *chance.choice(kinds)) for complete in sorted(chance.choices(range(MESHES + 1), k=count))
    )


@dataclass(frozen=True)
class Sequence:
    """What came of a sequence of strikes.

    Attributes:
        strikes: The strikes that came before the run had ended.
        seconds: Seconds until the run had ended.
        commands: Number of times that the command was given.
        differences: Differences from the store of an undisturbed run; there should be none.
    """

    strikes: tuple[Strike, ...]
    seconds: float
    commands: int
    differences: tuple[str, ...]


def strike_all(folder: Path, plans: Mapping[int, tuple[Strike, ...]]) -> Iterator[Sequence]:
    """Yield what comes of each plan, on a study that takes some seconds; the key of a plan chooses its victims."""
    study = write_study(folder, MESHES, seed=0, cells=24, level=3)
    clean = Location.parse(folder / "clean.zarr")
    with local_client(WORKERS) as client:
        run(Study.from_toml(study), clean, client)
    for seed, strikes in plans.items():
        own = folder / f"seed-{seed}"
        own.mkdir()
        yield _strike(study, clean, own, seed, strikes)


def _strike(study: Path, clean: Location, folder: Path, seed: int, strikes: tuple[Strike, ...]) -> Sequence:
    store = folder / "struck.zarr"
    due = list(strikes)
    came: list[Strike] = []
    chance = random.Random(seed)
    started = time.monotonic()
    with _Cluster.started(folder) as cluster:
        driver = _Driver(study, store, cluster.address, folder)
        while not driver.is_done:
            if time.monotonic() - started > _LONGEST_SECONDS:
                return Sequence(tuple(came), _LONGEST_SECONDS, driver.commands, ("the run has not ended",))
            time.sleep(_POLL_SECONDS)
            cluster.revive()
            driver.revive(cluster)
            fields = _complete_fields(store)
            if due and len(fields) >= due[0].complete and _befall(due[0], cluster, driver, fields, chance):
                came.append(due.pop(0))
        seconds = time.monotonic() - started
    return Sequence(tuple(came), seconds, driver.commands, tuple(differences(Location.parse(store), clean)))


def counts(sequences: list[Sequence]) -> Counter[str]:
    """Count the strikes of sequences by kind."""
    return Counter(f"{one.role} {one.what}" for sequence in sequences for one in sequence.strikes)


def _befall(strike: Strike, cluster: _Cluster, driver: _Driver, fields: list[Path], chance: random.Random) -> bool:
    """Return whether a strike came: its victim may not be there yet."""
    if (strike.role, strike.what) == EXCHANGED:
        if len(fields) < 2:
            return False
        one, other = chance.sample(fields, 2)
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)
        return True
    victims = [driver.process] if strike.role == "driver" else cluster.processes(strike.role)
    victims = [victim for victim in victims if _is_running(victim)]
    if not victims:
        return False
    chance.choice(victims).send_signal(SIGNALS[strike.what])
    return True


@dataclass
class _Driver:
    """The command that carries out the study, given again until the store is whole.

    Attributes:
        is_done: True once the study is computed, and verified.
        commands: Number of times that it was given.
        process: Its latest process.
    """

    study: Path
    store: Path
    scheduler: str
    folder: Path
    is_done: bool = False
    commands: int = 0
    process: psutil.Popen = field(init=False)
    stopped_since: float | None = None

    def __post_init__(self) -> None:
        self._give()

    def revive(self, cluster: _Cluster) -> None:
        """Do what somebody does who looks at the terminal."""
        status = self.process.poll()
        if status is None:
            self._continue_if_stopped()
        elif status == 0 and self._is_verified():
            self.is_done = True
        else:
            # The command has told that the scheduler is lost, or that there is no worker: people kill what is stopped.
            cluster.kill_stopped()
            self._give()

    def _give(self) -> None:
        self.commands += 1
        options = ["--store", str(self.store), "--scheduler", self.scheduler, "--give-up-after", "10"]
        self.process = _start([*COMMAND, "run", str(self.study), *options], self.folder / f"driver-{self.commands}.log")

    def _continue_if_stopped(self) -> None:
        if self.process.status() != psutil.STATUS_STOPPED:
            self.stopped_since = None
        elif self.stopped_since is None:
            self.stopped_since = time.monotonic()
        elif time.monotonic() - self.stopped_since > _STOPPED_DRIVER_SECONDS:
            self.process.send_signal(signal.SIGCONT)

    def _is_verified(self) -> bool:
        verify = [*COMMAND, "verify", str(self.store)]
        return subprocess.run(verify, capture_output=True, timeout=_LONGEST_SECONDS).returncode == 0


@dataclass
class _Cluster:
    """A scheduler and workers with nannies, all of them processes, started again where they ended."""

    folder: Path
    port: int
    scheduler: psutil.Popen = field(init=False)
    nannies: list[psutil.Popen] = field(default_factory=list)
    starts: int = 0

    @classmethod
    @contextmanager
    def started(cls, folder: Path) -> Iterator[_Cluster]:
        """Start a cluster, and kill it in the end."""
        cluster = cls(folder, _free_port())
        try:
            cluster.scheduler = cluster._start_scheduler()
            cluster.nannies = [cluster._start_nanny() for _ in range(WORKERS)]
            yield cluster
        finally:
            for process in [cluster.scheduler, *cluster.nannies]:
                _kill(process)

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def processes(self, role: str) -> list[psutil.Process]:
        """Return the processes of a role."""
        if role == "scheduler":
            return [self.scheduler]
        return [one for nanny in self.nannies for one in ([nanny] if role == "nanny" else _workers_of(nanny))]

    def revive(self) -> None:
        """Start again what has ended."""
        if self.scheduler.poll() is not None:
            self.scheduler = self._start_scheduler()
        for index, nanny in enumerate(self.nannies):
            if nanny.poll() is not None:
                self.nannies[index] = self._start_nanny()

    def kill_stopped(self) -> None:
        """Kill the scheduler if it is stopped, and each nanny that is stopped or has a stopped worker."""
        for process in (self.scheduler, *self.nannies):
            if not all(map(_is_running, [process, *(_workers_of(process) if process in self.nannies else [])])):
                _kill(process)

    def _start_scheduler(self) -> psutil.Popen:
        return self._start("scheduler", "--port", str(self.port))

    def _start_nanny(self) -> psutil.Popen:
        return self._start("worker", self.address, "--nthreads", "1", "--local-directory", str(self.folder))

    def _start(self, *arguments: str) -> psutil.Popen:
        self.starts += 1
        loopback = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
        return _start(
            [sys.executable, "-m", "dask", *arguments, *loopback], self.folder / f"{arguments[0]}-{self.starts}.log"
        )


def _start(command: list[str], log: Path) -> psutil.Popen:
    with log.open("w") as output:
        return psutil.Popen(command, stdout=output, stderr=subprocess.STDOUT)


def _kill(process: psutil.Popen) -> None:
    """Kill a process and those that it started."""
    try:
        family = [*process.children(recursive=True), process]
    except psutil.NoSuchProcess:
        family = []
    for one in family:
        try:
            one.kill()
        except psutil.NoSuchProcess:
            continue
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


def _complete_fields(store: Path) -> list[Path]:
    """Return the fields of the meshes that have a record."""
    fields = store / "fourier" / "fourier" / "c"
    rows = [record.name for record in (store / "records" / "record" / "c").glob("[0-9]*")]
    return sorted(chunk for row in rows for chunk in (fields / row).rglob("*") if chunk.is_file())


def _free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])
