"""What `plan`, `run` and `submit` settle first: the place of the store, permissions, and warnings."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.parameters import format_bytes
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import quoted
from sobolev_batch.sources.registry import ExpectedSize, Member
from sobolev_batch.store.location import Location
from sobolev_batch.study.plan import members_of
from sobolev_batch.study.schema import known_names
from sobolev_batch.study.study import REFERENCE_LABEL, AnyStudy, Study, StudyCollection, StudyLike, as_study
from sobolev_batch.tables.pairs import PAIR_BYTES

_log = logging.getLogger(__name__)

# A store as functions take it that have a default.
StoreLike = str | Path | Location | None
# Ends of a range of logarithms of sizes.
Range = tuple[float, float]

_DEFAULT_FOLDER = Path("storage")
# Folder beside a store for the meshes that its study makes, and commands that a refusal lists.
_MADE_MESHES, _MOST_COMMANDS = "made-meshes", 3
# Methods whose ranges of sizes miss each other by less than this are compared between their ends.
_LARGEST_GAP = 1.2
# A p-value below it counts as a difference.
SIGNIFICANCE = 0.05


def settled(study: StudyLike, store: StoreLike, *, may_run: bool) -> tuple[AnyStudy, Location]:
    """Return a study that keeps the meshes that it makes beside its store, and the place of the store.

    Stores there share the meshes. The place is storage/NAME.zarr where none is named.
    """
    study = as_study(study)
    location = Location.parse(_DEFAULT_FOLDER / f"{study.name}.zarr" if store is None else store)
    return study.with_cache(MeshCache(location.absolute().beside(_MADE_MESHES), may_run)), location


def ready_to_run(
    study: StudyLike, store: StoreLike, *, allow_commands: bool, only: Sequence[str] = ()
) -> tuple[AnyStudy, Location]:
    """Return a study that may run, or a part of it, and its place; log what would make the run useless."""
    study = as_study(study).with_only(tuple(only))
    _require_members(study, only)
    study, location = settled(study, store, may_run=True)
    require_permission(study, allow_commands)
    if store is None:
        # Other folders are not made: their names may be mistakes.
        with location.access("written"):
            _DEFAULT_FOLDER.mkdir(exist_ok=True)
    for text in warnings_of(study, location):
        _log.warning("%s", text)
    return study, location


def _require_members(study: AnyStudy, only: Sequence[str]) -> None:
    """Refuse names of families and members that no object of a study has."""
    families: dict[str, str] = {}
    studies = [study] if isinstance(study, Study) else [*study.studies.values()]
    for one in studies if only else ():
        # The run reports what cannot be listed.
        with suppress(InputError):
            families |= {label: family for label, (family, _) in members_of(one).items()}
    for name in only:
        alone = studies[0].with_only((name,))
        if not any(alone.chooses(family, label) for label, family in families.items()):
            known = dict.fromkeys([*families.values(), *families])
            raise StudyError(f"no family or member of the study is {quoted(name)}; {known_names(name, known)}")


def require_permission(study: AnyStudy, allow_commands: bool) -> None:
    """Refuse a study that runs commands and may not, by a StudyError."""
    if study.commands and not allow_commands:
        raise StudyError(
            f"the study runs commands: {', '.join(study.commands[:_MOST_COMMANDS])}; if you trust it, allow them by "
            "--allow-commands (in Python: allow_commands=True)"
        )


def warnings_of(study: AnyStudy, store: Location) -> tuple[str, ...]:
    """Return a line for each thing that makes a run fail late, or useless: sizes, too few objects, or no space."""
    if isinstance(study, Study) and study.pairs != "all" and len(study.families) == 1:
        return ()
    collection = study if isinstance(study, StudyCollection) else None
    studies = {"": study} if isinstance(study, Study) else study.studies
    members: dict[str, dict[str, tuple[str, Member]]] = {}
    for name, one in studies.items():
        # The run reports what cannot be listed.
        with suppress(InputError):
            members[name] = members_of(one)
    gaps = {name: _gap_in_sizes(listed.values(), alone=collection is None) for name, listed in members.items()}
    gaps = {name: gap for name, gap in gaps.items() if gap}
    warnings = []
    if gaps:
        first, gap = next(iter(gaps.items()))
        where = f" for {len(gaps)} of {len(studies)} objects, such as {first}" if first else ""
        warnings.append(f"{gap}; methods cannot be ranked at equal triangles{where}; add meshes of sizes that all have")
    if collection is not None:
        useful = [name for name in members if name not in gaps and name not in collection.lacking]
        warnings += _test_warnings(collection, len(useful))
    matrix_bytes = {
        name: PAIR_BYTES * len(studies[name].orders) * len(listed) ** 2
        for name, listed in members.items()
        if studies[name].pairs == "all"
    }
    return (*warnings, *_space_warnings(matrix_bytes, store))


def _gap_in_sizes(members: Iterable[tuple[str, Member]], *, alone: bool) -> str:
    """Return which families have no range of sizes in common; nothing where they have one, or might.

    Where an object is alone, only families of several sizes count: others need not be meant for a comparison by size.
    """
    sizes: dict[str, list[ExpectedSize]] = {}
    for family, member in members:
        if family != REFERENCE_LABEL and member.time is None:
            sizes.setdefault(family, []).append(member.expected_size())
    known = {
        family: [(size.triangles, size.factor) for size in listed]
        for family, listed in sizes.items()
        if all(size.triangles > 0 and math.isfinite(size.factor) for size in listed)
        and len({size.triangles for size in listed}) > alone
    }
    likely = {family: _range_of(count for count, _ in listed) for family, listed in known.items()}
    largest = [_range_of(end for count, by in listed for end in (count / by, count * by)) for listed in known.values()]
    return gap_of(likely) if known and common_range(largest) is None else ""


def _range_of(sizes: Iterable[float]) -> Range:
    listed = list(sizes)
    return math.log(min(listed)), math.log(max(listed))


def common_range(ranges: Iterable[Range]) -> Range | None:
    """Return the range that all have in common, or twice the middle between their ends where these nearly meet."""
    begins, ends = zip(*ranges, strict=True)
    low, high = max(begins), min(ends)
    if low <= high:
        return low, high
    middle = (low + high) / 2
    return (middle, middle) if low - high <= math.log(_LARGEST_GAP) else None


def gap_of(ranges: Mapping[str, Range]) -> str:
    """Return which methods have no range of sizes in common."""
    first = max(ranges, key=lambda method: ranges[method][0])
    last = min(ranges, key=lambda method: ranges[method][1])
    begin, end = math.exp(ranges[first][0]), math.exp(ranges[last][1])
    return f"no common range of sizes: {first} begins at {begin:,.5g}, {last} ends at {end:,.5g}"


def least_objects(tests: int) -> int:
    """Return with how many objects the most extreme of all changes of sign is rare enough, among several tests.

    >>> least_objects(1), least_objects(6)
    (6, 8)
    """
    # Of 2^n changes of sign two are as extreme.
    return math.floor(math.log2(2 * tests / SIGNIFICANCE)) + 1


def _test_warnings(collection: StudyCollection, objects: int) -> Iterator[str]:
    """Yield what makes a league useless whose test can tell no two methods apart."""
    methods = {family.name for study in collection.studies.values() for family in study.families}
    pairs, count = math.comb(len(methods), 2), len(collection.studies)
    if pairs and objects < (least := least_objects(pairs)):
        shown = f"{count} object{'s' * (count != 1)}"
        shown = shown if objects == count else f"{objects} of {shown} that have all methods at common sizes"
        yield (
            f"the test of a league cannot tell {len(methods)} methods from chance with {shown}; "
            f"take {least} objects or more, or compare fewer methods (table league --family)"
        )


def _space_warnings(matrix_bytes: Mapping[str, int], store: Location) -> Iterator[str]:
    """Yield the need for space of the distances of all pairs, by object, where a disk does not have it."""
    if store.scheme or not matrix_bytes:
        return
    places = [store.below(name) if name else store for name in matrix_bytes]
    stored = sum(size for place in places for size in place.sizes("distances").values())
    needed, folder = sum(matrix_bytes.values()), Path(str(store)).absolute()
    disk = shutil.disk_usage(next(one for one in (folder, *folder.parents) if one.exists()))
    # Some file systems do not say how large they are.
    if disk.total and needed - stored > disk.free:
        yield (
            f'pairs = "all": the distances of all pairs take {format_bytes(needed)} on disk, and '
            f"{format_bytes(disk.free)} are free at {store}; "
            'set pairs = "reference" in [compare], or choose another place with --store'
        )
