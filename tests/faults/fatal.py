"""Loaded into a worker before it starts: ends or stops it at one moment of the tasks of one row.

The moment is in the environment, which workers have from the process that starts them.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sobolev_batch.store.field_arrays import Fields
from sobolev_batch.store.records import Records

VARIABLE = "FATAL_MOMENT"
_FUNCTIONS: dict[str, tuple[type, str]] = {
    "field": (Fields, "write"),
    "rename": (Path, "replace"),
    "record": (Records, "write"),
    "recorded": (Records, "write"),
}


@dataclass(frozen=True)
class Moment:
    """When a worker ends, or what else a signal has it do."""

    # "field", before it is written; "rename", between its file and its name; "record", before it; "recorded", after it.
    what: str
    row: int
    # A file with a line for each worker that got the signal, and how many of all workers get it.
    log: str
    times: int = 1
    number: int = signal.SIGKILL

    @property
    def pids(self) -> list[int]:
        path = Path(self.log)
        return list(map(int, path.read_text().split())) if path.exists() else []

    def strike(self) -> None:
        """End or stop this process, unless enough have."""
        for number in range(self.times):
            try:
                os.close(os.open(f"{self.log}.{number}", os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            with Path(self.log).open("a") as log:
                log.write(f"{os.getpid()}\n")
            # To this thread, which goes no further then; the rest of the process stops or ends with it.
            signal.pthread_kill(threading.get_ident(), self.number)
            return


def dask_setup(worker: object) -> None:
    """What Dask calls in a worker that has this for a preload."""
    moment = Moment(**json.loads(os.environ[VARIABLE]))
    owner, name = _FUNCTIONS[moment.what]
    function = getattr(owner, name)

    def wrapped(*arguments: Any, **options: Any) -> Any:
        place = f"fourier/fourier/c/{moment.row}/"
        concerned = place in str(arguments[0]) if owner is Path else arguments[1] == moment.row
        if concerned and moment.what != "recorded":
            moment.strike()
        returned = function(*arguments, **options)
        if concerned and moment.what == "recorded":
            moment.strike()
        return returned

    setattr(owner, name, wrapped)
