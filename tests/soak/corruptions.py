"""Files of a finished store that are damaged at random, one at a time, and what each way to read it then says."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from sobolev_batch import SobolevBatchError, Study, open_store, run
from sobolev_batch.batch.cluster.clients import local_client
from tests.soak.studies import STUDY, write_meshes
from tests.support.commands import call

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
    octaves, all_pairs = ("M = 24", "M = 10\noctaves = 1"), ('pairs = "reference"', 'pairs = "all"')
    study.write_text(STUDY.replace(*octaves).replace(*all_pairs) + _SPHERES)
    chance = np.random.default_rng(0)
    with local_client(1) as client:
        for name, count in (("foreign", _MESHES), ("whole", _MESHES), ("whole", 1)):
            if stores[name].exists():
                shutil.copytree(stores[name], stores["earlier"])
            write_meshes(folder, range(count), chance)
            run(Study.from_toml(study), stores[name], client)
    return stores


@dataclass(frozen=True)
class Corruption:
    """A file of a store that was damaged.

    Attributes:
        kind: What was done to it.
        keys: Keys of the files whose content changed.
        answers: What each way to read the store that was tried then did, one of `ANSWERS`: a number differs without a
            word where it is silent, only `verify` has said so where it is verified, and an exception was not one of
            this package where it is unnamed.
    """

    kind: str
    keys: tuple[str, ...]
    answers: Mapping[str, str]


def corruptions(folder: Path, count: int, seed: int) -> Iterator[Corruption]:
    """Yield so many corruptions of one store."""
    stores = finished_stores(folder)
    whole = stores["whole"]
    chance = random.Random(seed)
    keys = sorted(str(path.relative_to(whole)) for path in whole.rglob("*") if path.is_file())
    damaged = folder / "damaged.zarr"
    shutil.copytree(whole, damaged)
    truths = {name: read(damaged) for name, read in WAYS.items()}
    while count:
        kind = chance.choice(sorted(KINDS))
        changed = KINDS[kind](damaged, chance.choice(keys), stores, chance)
        if not changed:
            continue
        answers = {
            name: _answer(read, damaged, truths[name])
            for name, read in WAYS.items()
            if name != "report" or not count % _REPORTS_EVERY
        }
        if answers["verify"] == "told":
            answers = {name: "verified" if answer == "silent" else answer for name, answer in answers.items()}
        yield Corruption(kind, changed, answers)
        shutil.rmtree(damaged)
        shutil.copytree(whole, damaged)
        count -= 1


def _answer(read: Callable[[Path], dict[str, str]], store: Path, truth: dict[str, str]) -> str:
    """Return what a way to read a store did."""
    try:
        found = read(store)
    except _ToldError:
        return "told"
    except Exception:
        return "unnamed"
    return answer_to(found, truth)


def answer_to(found: Mapping[str, str], truth: Mapping[str, str]) -> str:
    """Return what texts say beside those of a whole store."""
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
    said = _command("report", "STORE", "--witness", "ico/0", "--output", str(page))(store)
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


# Damages a file of a store, by its key; gives the keys of the files whose content changed.
_Damage = Callable[[Path, str, Mapping[str, Path], random.Random], tuple[str, ...]]


def _rewritten(change: Callable[[bytes, random.Random], bytes]) -> _Damage:
    def damage(store: Path, key: str, stores: Mapping[str, Path], chance: random.Random) -> tuple[str, ...]:
        before = (store / key).read_bytes()
        after = change(before, chance)
        (store / key).write_bytes(after)
        return (key,) if after != before else ()

    return damage


def _flipped(content: bytes, chance: random.Random) -> bytes:
    place = chance.randrange(len(content))
    return content[:place] + bytes([content[place] ^ chance.randrange(1, 256)]) + content[place + 1 :]


def _zeroed(content: bytes, chance: random.Random) -> bytes:
    start = chance.randrange(len(content))
    end = chance.randrange(start, len(content)) + 1
    return content[:start] + bytes(end - start) + content[end:]


def _delete(store: Path, key: str, stores: Mapping[str, Path], chance: random.Random) -> tuple[str, ...]:
    (store / key).unlink()
    return (key,)


def _swap(store: Path, key: str, stores: Mapping[str, Path], chance: random.Random) -> tuple[str, ...]:
    """Exchange a file with another one, of equal size where there is one."""
    content = (store / key).read_bytes()
    others = [path for path in store.rglob("*") if path.is_file() and path.read_bytes() != content]
    alike = [path for path in others if path.stat().st_size == len(content)]
    other = chance.choice(sorted(alike or others))
    (store / key).write_bytes(other.read_bytes())
    other.write_bytes(content)
    return (key, str(other.relative_to(store)))


def _from(state: str) -> _Damage:
    def replace(store: Path, key: str, stores: Mapping[str, Path], chance: random.Random) -> tuple[str, ...]:
        source = stores[state] / key
        return _rewritten(lambda *_: source.read_bytes())(store, key, stores, chance) if source.exists() else ()

    return replace


KINDS: dict[str, _Damage] = {
    "byte flipped": _rewritten(_flipped),
    "cut short": _rewritten(lambda content, chance: content[: chance.randrange(len(content))]),
    "stretch zeroed": _rewritten(_zeroed),
    "deleted": _delete,
    "exchanged with another": _swap,
    "from an earlier state": _from("earlier"),
    "from another store": _from("foreign"),
}
