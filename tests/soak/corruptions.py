"""Files of a finished store that are damaged at random, one at a time, and what each way to read it then says."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from itertools import combinations, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from sobolev_batch import Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from sobolev_batch.errors import SobolevBatchError
from tests.soak.studies import STUDY, write_meshes
from tests.support.commands import call
from tests.support.stores import contents, put_back

_MESHES = 2
_SPHERES = """
[[family]]
name = "ico"
source = "icosphere"
levels = [0, 1]
"""
BAD = ("silent", "unnamed")
ANSWERS = ("same", "told", "verified", *BAD)
# Charts take most of the time. A report reads what the other ways read.
_REPORTS_EVERY = 5
# What a page or a status says of the moment at which it was made.
_MOMENTS = re.compile(r"\d+(\.\d+)? (s|min|h|seconds|minutes|hours)\b( ago)?|\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?\S*")


def finished_stores(folder: Path) -> dict[str, Path]:
    """Compute a whole store, one of an earlier state before a mesh changed, and a foreign one of other meshes."""
    stores = {name: folder / f"{name}.zarr" for name in ("whole", "earlier", "foreign")}
    study = folder / "study.toml"
    octaves, all_pairs = ("M = 24", "M = 10\noctaves = 1"), ("[reference]", '[compare]\npairs = "all"\n[reference]')
    study.write_text(STUDY.replace(*octaves).replace(*all_pairs) + _SPHERES)
    chance = np.random.default_rng(0)
    with local_client(1) as client:
        for name, count in (("foreign", _MESHES), ("whole", _MESHES), ("whole", 1)):
            if stores[name].exists():
                shutil.copytree(stores[name], stores["earlier"])
            write_meshes(folder, range(count), chance)
            run(Study.from_toml(study), stores[name], client)
    return stores


class Corruption(NamedTuple):
    """What was done to files of a store, by their keys, and which of `ANSWERS` each way to read it then gave.

    A number differs without a word where it is silent, only `verify` has said so where it is verified, and an exception
    was not one of this package where it is unnamed.
    """

    kind: str
    keys: tuple[str, ...]
    answers: Mapping[str, str]


Damages = Iterator[tuple[str, dict[str, bytes | None]]]


def corruptions(folder: Path, count: int, seed: int) -> Iterator[Corruption]:
    """Damage a finished store some times, by a seed, and yield what that led to."""
    yield from _damaged(folder, lambda states: islice(damages(states, random.Random(seed)), count))


def mixed_states(folder: Path) -> Iterator[Corruption]:
    """Restore each subset of the groups of a finished store to an earlier state, and yield what that led to."""
    yield from _damaged(folder, restorations)


def _damaged(folder: Path, choose: Callable[[Mapping[str, Mapping[str, bytes]]], Damages]) -> Iterator[Corruption]:
    stores = finished_stores(folder)
    store = stores["whole"]
    truths = {name: read(store) for name, read in WAYS.items()}
    states = {
        name: {path.relative_to(place).as_posix(): content for path, content in contents(place).items()}
        for name, place in stores.items()
    }
    for number, (kind, changes) in enumerate(choose(states)):
        with put_back(store):
            for key, content in changes.items():
                (store / key).unlink(missing_ok=True)
                if content is not None:
                    (store / key).parent.mkdir(parents=True, exist_ok=True)
                    (store / key).write_bytes(content)
            answers = {
                name: _answer(read, store, truths[name])
                for name, read in WAYS.items()
                if name != "report" or not number % _REPORTS_EVERY
            }
        if answers["verify"] == "told":
            answers = {name: "verified" if answer == "silent" else answer for name, answer in answers.items()}
        yield Corruption(kind, tuple(changes), answers)


def restorations(states: Mapping[str, Mapping[str, bytes]]) -> Damages:
    """Yield each set of groups that differ between a whole store and an earlier state, and their earlier files."""
    whole, earlier = states["whole"], states["earlier"]
    changed = [key for key in sorted({*whole, *earlier}) if whole.get(key) != earlier.get(key)]
    groups = sorted({key.partition("/")[0] for key in changed})
    for size in range(1, len(groups)):
        for chosen in combinations(groups, size):
            yield ", ".join(chosen), {key: earlier.get(key) for key in changed if key.partition("/")[0] in chosen}


def damages(states: Mapping[str, Mapping[str, bytes]], chance: random.Random) -> Damages:
    """Yield kinds of damage to the files of a whole store, and what changed files then hold: None if they are gone."""
    whole = states["whole"]
    while True:
        key = chance.choice(sorted(whole))
        content = whole[key]
        place, end = sorted(chance.choices(range(len(content)), k=2))
        others = [name for name in sorted(whole) if whole[name] != content]
        other = chance.choice([name for name in others if len(whole[name]) == len(content)] or others)
        flipped = content[place] ^ chance.randrange(1, 256)
        kinds: dict[str, dict[str, bytes | None]] = {
            "byte flipped": {key: content[:place] + bytes([flipped]) + content[place + 1 :]},
            "cut short": {key: content[:place]},
            "stretch zeroed": {key: content[:place] + bytes(end + 1 - place) + content[end + 1 :]},
            "deleted": {key: None},
            "exchanged with another": {key: whole[other], other: content},
            "from an earlier state": {key: states["earlier"].get(key, content)},
            "from another store": {key: states["foreign"].get(key, content)},
        }
        kind = chance.choice(sorted(kinds))
        if kinds[kind][key] != content:
            yield kind, kinds[kind]


def _answer(read: Callable[[Path], dict[str, str]], store: Path, truth: dict[str, str]) -> str:
    try:
        return answer_to(read(store), truth)
    except _ToldError:
        return "told"
    except Exception:
        return "unnamed"


def answer_to(found: Mapping[str, str], truth: Mapping[str, str]) -> str:
    if found.get(_REMARKS) != truth.get(_REMARKS):
        return "told"
    told = {key for key, text in found.items() if text.startswith(_TOLD) or _IS_TOLD.search(text)}
    if any(found.get(key, text) != text for key, text in truth.items() if key not in told):
        return "silent"
    return "told" if told or found.keys() < truth.keys() else "same"


class _ToldError(Exception):
    """A way to read a store has said that something is wrong."""


_TOLD = "told: "
# How a status names records that are gone or damaged.
_IS_TOLD = re.compile("completion record is (gone|damaged)")
# What a command says besides its output.
_REMARKS = "remarks"


def _command(*arguments: str) -> Callable[[Path], dict[str, str]]:
    def read(store: Path) -> dict[str, str]:
        done = call(*(str(store) if argument == "STORE" else argument for argument in arguments), folder=store.parent)
        if "Traceback" in done.stderr or "report this" in done.stderr:
            raise RuntimeError(done.stderr)
        if done.returncode:
            raise _ToldError(done.stderr)
        return {_REMARKS: _MOMENTS.sub("", done.stderr), "output": _MOMENTS.sub("", done.stdout)}

    return read


def _page(store: Path) -> dict[str, str]:
    page = store.with_name("page.html")
    said = _command("report", "STORE", "--mesh", "ico/0", "--output", str(page))(store)
    return said | {"page": _MOMENTS.sub("", page.read_text(encoding="utf-8"))}


def _arrays(store: Path) -> dict[str, str]:
    """Return the content of each array, or what is said about it."""
    try:
        tree = open_store(store)
    except SobolevBatchError as error:
        raise _ToldError from error
    return {
        f"{node.path}/{name}": _content(str(name), array)
        for node in tree.subtree
        for name, array in node.to_dataset(inherit=False).variables.items()
    } | {node.path: str(node.attrs) for node in tree.subtree}


def _content(name: str, array: xr.Variable) -> str:
    try:
        values = array.values
    except SobolevBatchError as error:
        return f"{_TOLD}{error}"
    if name == "record":
        # The records of one mesh differ in where and when it was computed. One that is gone reads as none yet does.
        return f"{array.dims}"
    return f"{array.dims} {array.attrs} {values.dtype} {values.tolist()}"


WAYS: dict[str, Callable[[Path], dict[str, str]]] = {
    "table": _command("table", "STORE", "--format", "csv"),
    "status": _command("status", "STORE"),
    "report": _page,
    "open_store": _arrays,
    # Last, since it withdraws what is damaged.
    "verify": _command("verify", "STORE"),
}
