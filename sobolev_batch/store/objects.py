"""The objects of a store: a group each, and at the root what is known of all, so that few keys tell of thousands.

A study that names no object has its only one at the root itself.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self, TypeVar

from sobolev_batch.errors import DamageError, ForeignError, InputError, SobolevBatchError, StoreError
from sobolev_batch.sources.names import node_problem, quoted
from sobolev_batch.store.create import list_records, record_keys, require_same_study
from sobolev_batch.store.encoding import ROOT, group_document
from sobolev_batch.store.layout import OBJECTS, PAGE, RECORD, RECORDS, TABLES_OF_ALL, TAGS, Store
from sobolev_batch.store.location import Location
from sobolev_batch.store.lock import LOCK_KEYS
from sobolev_batch.store.metadata import SCHEMA_VERSION
from sobolev_batch.store.records import ObjectRecord, Records
from sobolev_batch.study.study import Study

Result = TypeVar("Result")
# What a root has beside its objects.
_AT_ROOT = frozenset({ROOT, RECORDS, TAGS, *LOCK_KEYS, *TABLES_OF_ALL})
_DESCRIPTION = (
    "Begin with the group convergence: distances of all objects' meshes to their references. Each object has a store "
    'of its own below this one. To read all its groups: xarray.open_datatree(store + "/NAME", engine="zarr"), or '
    'sobolev_batch.open_store(store + "/NAME"), with a name from "objects" in the attribute study'
)


@dataclass(frozen=True)
class Objects:
    """The objects of a study that names them: their groups below a root, and their records there.

    Attributes:
        root: Store of the records of objects, and of the table of all rows.
        names: Names of the objects, in the order of the study.
    """

    root: Store
    name: str
    names: tuple[str, ...]
    table: Mapping[str, Any]

    @property
    def location(self) -> Location:
        """Location of the root."""
        return self.root.location

    @property
    def records(self) -> Records[ObjectRecord]:
        """Records of the objects, whose rows are in the order of their names."""
        return Records(self.root, ObjectRecord)

    @cached_property
    def rows(self) -> dict[str, int]:
        """Row of each object by its name."""
        return {name: row for row, name in enumerate(self.names)}

    def recorded(self) -> dict[str, ObjectRecord]:
        """Return the records of the objects that have one, by name."""
        return {name: one for name, one in zip(self.names, self.records.read(), strict=True) if one is not None}

    @cached_property
    def tabulated(self) -> Mapping[str, None]:
        """Return the names of the objects that have rows in the tables at the root, as keys in the order of these."""
        return dict.fromkeys(self.root.read_strings("meshes/object") if "meshes" in self.root.documents else ())

    def existing_store(self, name: str) -> Location | None:
        """Return the store of an object, None before its reference was made; DamageError if it is lost or another."""
        try:
            store = Store(self.location.below(name))
            study = store.attributes()["study"]["name"] if store.exists() and not store.is_unfinished else None
        except ForeignError as error:
            raise DamageError(f"{error} (the object {name!r} was there)", str(error)) from error
        if study is None:
            if name in self.tabulated:
                problem = "its store is gone, and the tables of all objects have its rows"
                raise DamageError(f"{store.path}: {problem}; run the study again", problem)
            return None
        if study != f"{self.name} {name}":
            problem = f"it holds the study {study!r}, not that of the object {name!r}; put that back, or remove this"
            raise DamageError(f"{store.path}: {problem}", problem)
        return store.location

    @classmethod
    def read(cls, location: Location, *, is_thorough: bool = False) -> Self | None:
        """Return the objects of a store; None where it is that of an only object, or there is none.

        DamageError where the list of objects was altered. See `Store.has_digest` for what is thorough.
        """
        root = Store(location)
        with suppress(DamageError):  # An only object may have lost its root, which its readers say.
            if not root.exists():
                return None
        study = root.documents.get("", {}).get("attributes", {}).get("study")
        if not isinstance(study, dict) or OBJECTS not in study:
            return None
        if not root.lacks_tables and not root.has_digest(is_thorough=is_thorough):
            raise root.damage("the list of its objects, or the table of all rows,", "it is not what was written")
        root.attributes(of_objects=True)
        for name in study[OBJECTS]:
            if unfit := node_problem(name):
                raise StoreError(f"{location}: the store is not used: an object has the name {quoted(name)}: {unfit}")
        return cls(root, study["name"], tuple(study[OBJECTS]), study["table"])

    def _require_fields_of(self, study: Study) -> None:
        """Refuse other fields, as stores of objects do, before the root has the table of the other study."""
        if all(self.table.get(section) == study.table.get(section) for section in ("lattice", "transform")):
            return
        for name in self.recorded():
            with suppress(DamageError):
                if (place := self.existing_store(name)) is not None:
                    held = Store(place).attributes()["study"]
                    require_same_study(self.location, held, held["name"], study)
                    return

    @classmethod
    def prepared(cls, location: Location, study: Study) -> Self:
        """Write down at a location which objects a study has; records of those that it had before stay."""
        present = None
        with suppress(DamageError):
            present = cls.read(location)
        if present is None:
            # Where it is damaged, the stores of the objects are still there, and of those that the study has lost.
            location.require_free(_AT_ROOT.union(study.objects, lost_objects(location, study.name, study.objects)))
        elif present.name != study.name:
            raise StoreError(
                f"{location}: it holds the store of another study, {present.name!r}, not {study.name!r}; "
                "name another store, or remove this one"
            )
        else:
            present._require_fields_of(study)
        location.remove_partial_files(besides=location.names() - _AT_ROOT)
        root = Store(location) if present is None else present.root
        entry = {
            "name": study.name,
            "orders": list(study.orders),
            OBJECTS: list(study.objects),
            "lacking": {name: list(one.lacking) for name, one in study.objects.items() if one.lacking},
            "table": dict(study.table),
        }
        attributes = {"title": study.title, "description": _DESCRIPTION, "schema_version": SCHEMA_VERSION}
        root.documents[""] = group_document({**attributes, "study": entry})
        made = cls(root, study.name, tuple(study.objects), study.table)
        if present is None or present.names != made.names:
            kept = {} if present is None else present.recorded()
            for name in (RECORD, PAGE):
                root.location.remove(name)
            list_records(root)
            root.publish(record_keys(len(made.names), "object"))
            for name, record in kept.items():
                if name in made.rows:
                    made.records.write(made.rows[name], record)
        root.consolidate()
        return made


def lost_objects(location: Location, study: str, known: Iterable[str]) -> list[str]:
    """Return the names at a root, sorted, that have stores of objects of a study, but for those of known objects.

    Whatever else lies there is not ours, and another store least of all.
    """
    lost = []
    for name in sorted(location.names() - _AT_ROOT.union(known)):
        with suppress(StoreError):
            if Store(location.below(name)).attributes()["study"]["name"] == f"{study} {name}":
                lost.append(name)
    return lost


def stores_below(location: Location) -> dict[str, Location]:
    """Return the stores of all objects that have one, by name; that of an only object without a name is under "".

    Of objects that the latest run could not carry out, they are of an earlier state of the study, and left out; and so
    are those without rows in the tables at the root, where there are any: they are of other settings, or not finished;
    and those whose stores a run has changed that was killed before these tables.
    """
    if (objects := Objects.read(location)) is None:
        return {"": location}
    refused = {name for name, one in objects.recorded().items() if one.reason or not (one.key or one.settings)}
    own = (name for name in objects.tabulated or objects.rows if name not in refused)
    return {name: place for name in own if (place := objects.existing_store(name)) is not None}


def root_of(location: Location) -> Location:
    """Return the root of the store that a location lies in, where the lock is: an object's lies above its own."""
    name = location.name.rpartition("/")[2]
    # Damage of its tables changes nothing of that.
    with suppress(StoreError):
        above = location.beside("")
        if name in Store(above).attributes(of_objects=True)["study"][OBJECTS]:
            return above
    return location


def ends_all(error: Exception) -> bool:
    """Tell whether an error at one object, or mesh, would come at all: their storage fails, or we made a mistake."""
    is_of_storage = isinstance(error, StoreError) and not isinstance(error, DamageError | ForeignError)
    return is_of_storage or not isinstance(error, SobolevBatchError)


def for_each_object(
    study: Study, location: Location, act: Callable[[Study, Location], Result]
) -> tuple[dict[str, Result], dict[str, str]]:
    """Act on the study and the store of each object; return results, and why others have none, by name.

    Errors of an only object without a name are raised, and those that end the work at all objects.
    """
    results, refused = dict[str, Result](), dict[str, str]()
    for name in study.objects:
        try:
            results[name] = act(study.of_object(name), location.below(name) if name else location)
        except InputError as error:
            if not name or ends_all(error):
                raise
            refused[name] = str(error)
    return results, refused


def labelled(entries: Mapping[str, Mapping[str, Result]]) -> dict[str, Result]:
    """Return what objects have by label, under labels that begin with the name of the object, where it has one."""
    return {"/".join(filter(None, (name, label))): one for name, own in entries.items() for label, one in own.items()}
