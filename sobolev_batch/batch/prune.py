"""Pruning: what a store keeps and no record needs, counted and removed."""

import logging
import re
from contextlib import nullcontext
from itertools import filterfalse

from sobolev_batch.store.encoding import ROOT
from sobolev_batch.store.layout import FIELD, GROUPS_OF_TASKS, OCTAVES, QUALITY, TABLES, TAGS, Store
from sobolev_batch.store.location import PARTIAL_FILE, Location
from sobolev_batch.store.lock import LOCK_KEYS, Lock, locked
from sobolev_batch.store.objects import Objects, lost_objects, root_of
from sobolev_batch.store.workspace import Contents

_log = logging.getLogger(__name__)

_LOST, _KILLED, _UNLISTED = (
    "fields of meshes that are no longer in the study",
    "leftovers of runs that were killed, and earlier fields of meshes that fail now",
    "tables that the store does not list",
)
# Other programs and people may leave files of their own beside those of rows, and at the root beside these.
_GROUPS = {*TABLES, *GROUPS_OF_TASKS}
_AT_ROOT = {*_GROUPS, ROOT, TAGS, *LOCK_KEYS}
_OF_ROW = re.compile(rf"((?:{FIELD}|{OCTAVES})/c/([0-9]+))/")


def prune_lost_objects(location: Location, *, is_dry: bool = True) -> int:
    """Remove the groups of objects that the study of a store has lost, and return their bytes; see `prune`."""
    objects, total = Objects.read(location), 0
    if objects is None:
        return 0
    with nullcontext() if is_dry else locked(location, Lock.of_this_process()):
        for name in lost_objects(location, objects.name, objects.names):
            place = location.below(name)
            if foreign := sorted(filterfalse(PARTIAL_FILE.search, place.names() - _AT_ROOT)):
                _log.warning("%s: no longer in the study, but kept: %s in it is not the store's", place, foreign[0])
                continue
            total += sum(place.sizes("").values())
            if not is_dry:
                location.remove(name)
    return total


def prune(location: Location, *, is_dry: bool = True) -> dict[str, int]:
    """Remove what a store keeps and no record needs, and return its bytes by kind; a dry run counts alone.

    These are fields of meshes that the study has lost, which would serve again if the meshes came back; what runs left
    that were killed, or meshes had before they failed; and tables that are not listed. StoreError where the location
    has no store of a study, cannot be written, is damaged, or a run is going on in it.
    """
    with nullcontext() if is_dry else locked(root_of(location), Lock.of_this_process()):
        store = Store.open(location)
        contents = Contents.of_store(store)
        lost, kept = set(range(len(contents.labels))) - contents.rows.keys(), contents.complete.keys()
        unlisted = _GROUPS - {name.split("/")[0] for name in store.documents}
        counts, prefixes = dict.fromkeys((_LOST, _KILLED, _UNLISTED), 0), set[str]()
        for key, size in location.sizes("").items():
            if PARTIAL_FILE.search(key):
                counts[_KILLED] += size
            elif place := _OF_ROW.match(key):
                if (row := int(place[2])) not in kept:
                    counts[_LOST if row in lost else _KILLED] += size
                    prefixes.add(place[1])
            elif (group := key.split("/")[0]) in unlisted:
                counts[_UNLISTED] += size
                prefixes.add(group)
        if not is_dry:
            # Records go first: one without its field would be damage.
            contents.withdraw(row for row in lost if contents.records[row] is not None)
            if lost:
                store.write(QUALITY, [0], contents.qualities)
            location.remove_partial_files()
            for prefix in prefixes:
                location.remove(prefix)
    return counts
