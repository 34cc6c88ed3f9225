"""Remeshers as families of one size after another: a source of meshes with a parameter that is searched."""

import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import ValidationError

from sobolev_batch.errors import InputError
from sobolev_batch.norms.columns import ANGLE, FILE_LENGTH
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.reduction.limit import Limit
from sobolev_batch.reduction.search import PRECISION, Search
from sobolev_batch.sources.command import RemeshedMember
from sobolev_batch.sources.mesh_cache import InMemory, MeshCache
from sobolev_batch.sources.programs import PLACEHOLDER
from sobolev_batch.sources.registry import Member, Source, parse_source, single_member, source_type_of

# What a remesher is asked for by default, and the fewest triangles of a closed mesh.
_TRIANGLES, _FEWEST = "triangles", 4
# A search first tries this number of triangles over the limit, as a fraction of the radius of the mesh or of its norm:
# decimations of five within 0.2 to 5 % of the radius, and 1 % of the norm at order -2, took 2 to 20, 10 in the mean.
_FIRST = 10.0
# Decimation works best at this size: five meshes of this radius kept 1.5 to 5 times fewer triangles than those of 1 or
# less within the same fraction of their radius, and those of 3,000 did not come below some number of triangles. And
# open borders move early if they may: half of the triangles of an open cow were off by 2.3 % of the radius, and by
# 0.09 % with its border kept.
_DECIMATION = {"radius": 100.0, "keep_boundary": True}
# It stands for the mesh of a source until that is given.
_ANY_MESH = {"source": "icosphere", "levels": [0]}

# A source's name, a command, a function or a family's table without its mesh; and the searched parameter with its ends.
Method = str | Callable[..., Any] | Mapping[str, Any]
Range = Mapping[str, tuple[float, float]]


def searched_parameter(search: Range | None) -> tuple[str, tuple[float, float] | None]:
    """Return the parameter that is searched, and its ends; by default triangles, whose ends depend on the mesh."""
    if search is None:
        return _TRIANGLES, None
    match [*search.items()] if isinstance(search, Mapping) else []:
        case [(str(name), (low, high))]:
            low, high = (end.item() if isinstance(end, np.generic) else end for end in (low, high))
            return name, (low, high)
    raise InputError(f"one parameter is searched, as in {{'triangles': (100, 1000)}}, found {search!r}")


class GivenSource(Source):
    """The source of one member that is at hand."""

    member: Any

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return the member."""
        return (self.member,)


@dataclass(frozen=True, eq=False)
class Remesher:
    """A family of meshes of one other mesh, with a parameter that makes them coarse or fine.

    Attributes:
        source: Source of such meshes, of any other mesh and for any values of the parameter.
        ends: Smallest and largest value to try, whole numbers for a parameter that takes those alone; None for numbers
            of triangles, up to that of the mesh itself, which is then not remeshed.
        folder: Folder in which relative paths start.
    """

    source: Source
    parameter: str = _TRIANGLES
    ends: tuple[float, float] | None = None
    folder: Path = field(default_factory=Path.cwd)

    @classmethod
    def parse(cls, method: Method, search: Range | None = None) -> Self:
        """Return the remesher that is meant; InputError or pydantic's ValidationError where none is."""
        table: Mapping[str, Any] = {"source": method}
        if isinstance(method, Mapping):
            table = method
        elif callable(method):
            table = {"source": "function", "function": method}
        elif isinstance(method, str) and PLACEHOLDER.search(method):
            table = {"source": "command", "command": shlex.split(method)}
        if table.get("source") == "decimate":
            table = {**_DECIMATION, **table}
        parameter, ends = searched_parameter(search)
        kind = source_type_of(table.get("source"))
        if parameter in table:
            raise InputError(f"{parameter} is searched, so it has no value of its own; take it out")
        if parameter not in kind.model_fields and kind.model_config.get("extra") != "allow":
            raise InputError(f"the source {table['source']} has no parameter {parameter} that could be searched")
        values = [*dict.fromkeys(ends or [_FEWEST])]
        try:
            source = parse_source({**table, parameter: values, "mesh": _ANY_MESH})
        except ValidationError as error:
            said = [one["msg"] for one in error.errors() if parameter in one["loc"]]
            if not said:
                raise
            demand = f"between {values[0]:g} and {values[-1]:g}: {said[0].replace('Input should', 'each must')}"
            raise InputError(f"{parameter} cannot be searched {demand}") from error
        remesher = cls(source, parameter, ends)
        # It refuses wrong ends.
        remesher.search(Limit(1.0), _FEWEST, 1.0)
        return remesher

    @property
    def is_whole(self) -> bool:
        """True where the parameter is a whole number."""
        return self.ends is None or all(map(is_whole_number, self.ends))

    def search(self, limit: Limit, triangles: int, radius: float, precision: float = PRECISION) -> Search:
        """Return the search for the coarsest mesh within a limit, made of one of some triangles and radius."""
        low, high = self.ends or (min(_FEWEST, triangles), triangles)
        if self.parameter != _TRIANGLES:
            return Search(limit.largest, low, high, self.is_whole, precision=precision)
        fraction = limit.largest / {FILE_LENGTH: radius, ANGLE: 90.0}.get(limit.units, 1.0)
        first = max(low, min(_FIRST / fraction, high / 2))
        return Search(limit.largest, low, high, self.is_whole, False, first, precision)

    def keeps(self, size: float, triangles: float) -> bool:
        """Tell whether the mesh of one size is the original itself, which has no more triangles."""
        return self.parameter == _TRIANGLES and size >= triangles

    def member(self, original: Member, size: float, triangles: float = math.inf) -> Member:
        """Return the mesh of one size that is made of another one, or that one itself where it has no more triangles.

        Its triangles are infinitely many by default.
        """
        if self.keeps(size, triangles):
            return original
        values = (int(size) if self.is_whole else size,)
        source = self.source.model_copy(update={self.parameter: values, "mesh": GivenSource(member=original)})
        member = single_member(source, self.folder)
        # Whoever searches may run it, and keeps the best mesh alone.
        kept = MeshCache(InMemory(), may_run=True)
        return replace(member, cache=kept) if isinstance(member, RemeshedMember) else member

    def fingerprint(self, original: Member) -> list[Any]:
        """Return what all meshes that are made of another one depend on; MeshError where that cannot be read."""
        one = self.member(original, _FEWEST if self.ends is None else self.ends[0])
        return [self.parameter, self.ends, one.fingerprint()]
