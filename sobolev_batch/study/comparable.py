"""Whether methods can be compared: at sizes that all of them have, and over enough objects for a test."""

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress

from sobolev_batch.errors import InputError
from sobolev_batch.sources.registry import Member
from sobolev_batch.study.schema import REFERENCE_LABEL
from sobolev_batch.study.study import Members, Study

# Ends of a range of logarithms of sizes.
Range = tuple[float, float]

# Methods whose ranges of sizes miss each other by less than this are compared between their ends.
_LARGEST_GAP = 1.2
# A p-value below it counts as a difference.
SIGNIFICANCE = 0.05


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


def comparison_warnings(study: Study) -> Iterator[str]:
    """Yield what makes a comparison of the study's methods useless. Surfaces are listed, and none is made."""
    gaps: dict[str, str] = {}
    for name, one in study.objects.items():
        # The run reports what cannot be listed, and such an object is none to compare at.
        with suppress(InputError):
            gaps[name] = _gap_in_sizes(one.members, alone=not name)
    if lacking := {name: gap for name, gap in gaps.items() if gap}:
        first, gap = next(iter(lacking.items()))
        where = f" for {len(lacking)} of {len(study.objects)} objects, such as {first}" if first else ""
        yield f"{gap}; methods cannot be ranked at equal triangles{where}; add meshes of sizes that all have"
    if "" not in study.objects:
        useful = [name for name, gap in gaps.items() if not gap and not study.objects[name].lacking]
        yield from _test_warnings(study, len(useful))


def _gap_in_sizes(members: Members, *, alone: bool) -> str:
    """Return which families have no range of sizes in common; nothing where they have one, or might.

    Where an object is alone, only families of several sizes count: others need not be meant for a comparison by size.
    """
    families: dict[str, list[Member]] = {}
    for family, member in members.values():
        if family != REFERENCE_LABEL and member.time is None:
            families.setdefault(family, []).append(member)
    if len(families) < 2:
        return ""
    likely: dict[str, Range] = {}
    largest: list[Range] = []
    for family, listed in families.items():
        sizes = [member.expected_size() for member in listed]
        counts = [size.triangles for size in sizes]
        if all(size.triangles > 0 and math.isfinite(size.factor) for size in sizes) and len({*counts}) > alone:
            likely[family] = math.log(min(counts)), math.log(max(counts))
            ends = [size.triangles * by for size in sizes for by in (1 / size.factor, size.factor)]
            largest.append((math.log(min(ends)), math.log(max(ends))))
    return gap_of(likely) if likely and common_range(largest) is None else ""


def _test_warnings(study: Study, objects: int) -> Iterator[str]:
    """Yield what makes a league useless whose test can tell no two methods apart."""
    methods = {family.name for one in study.objects.values() for family in one.families}
    pairs, count = math.comb(len(methods), 2), len(study.objects)
    if pairs and objects < (least := least_objects(pairs)):
        shown = f"{count} object{'s' * (count != 1)}"
        shown = shown if objects == count else f"{objects} of {shown} that have all methods at common sizes"
        yield (
            f"the test of a league cannot tell {len(methods)} methods from chance with {shown}; "
            f"take {least} objects or more, or compare fewer methods (table league --family)"
        )
