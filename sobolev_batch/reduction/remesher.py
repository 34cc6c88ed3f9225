"""Remeshers as families of one size after another: a source of meshes with a parameter that is searched."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.parameters import is_whole_number
from sobolev_batch.reduction.search import PRECISION, Search
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.programs import PLACEHOLDER
from sobolev_batch.sources.registry import Member, Source, parse_source, single_member

# What a remesher is asked for by default, and the fewest triangles of a closed mesh.
_TRIANGLES, _FEWEST = "triangles", 4
# Decimation works best at this size: five meshes of this radius kept 1.5 to 5 times fewer triangles than those of 1 or
# less within the same fraction of their radius, and those of 3,000 did not come below some number of triangles.
_RADIUS = 100.0
# Stands for the mesh of a source until that is given.
_ANY_MESH = {"source": "icosphere", "levels": [0]}

# The name of a source, a command, a function of a mesh, or the table of a family without its mesh; and the parameter
# that is searched with its ends.
Method = str | Callable[..., Any] | Mapping[str, Any]
Range = Mapping[str, tuple[float, float]]


class GivenSource(Source):
    """The source of one member that is at hand."""

    member: Any

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return the member."""
        return (self.member,)


@dataclass(frozen=True)
class _Nowhere:
    """A place where nothing is kept: who searches takes the meshes."""

    def read(self, key: str) -> bytes | None:
        """Return None."""
        return None

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Forget the documents."""


@dataclass(frozen=True, eq=False)
class Remesher:
    """A family of meshes of one other mesh, with a parameter that makes them coarse or fine.

    Attributes:
        table: Table of the family, without its mesh and the parameter.
        parameter: Name of the parameter.
        ends: Smallest and largest value to try, whole numbers for a parameter that takes those alone; None for numbers
            of triangles, up to that of the mesh itself, which is then not remeshed.
        cache: Permits commands to run, and knows their versions.
    """

    table: Mapping[str, Any]
    parameter: str = _TRIANGLES
    ends: tuple[float, float] | None = None
    cache: MeshCache = field(default_factory=lambda: MeshCache(_Nowhere(), may_run=True))

    @classmethod
    def parse(cls, method: Method, search: Range | None = None) -> Self:
        """Return the remesher that is meant; InputError where none is."""
        table: Mapping[str, Any] = {"source": method} | ({"radius": _RADIUS} if method == "decimate" else {})
        if isinstance(method, Mapping):
            table = method
        elif callable(method):
            table = {"source": "function", "function": method}
        elif PLACEHOLDER.search(method):
            table = {"source": "command", "command": shlex.split(method)}
        if search is None:
            remesher = cls(table)
        elif len(search) == 1:
            ((name, (low, high)),) = search.items()
            remesher = cls(table, name, (low, high))
        else:
            raise InputError(f"one parameter is searched, found {len(search)}; give the others fixed values")
        remesher.source(remesher.a_size)
        return remesher

    @property
    def a_size(self) -> float:
        """A size to be tried for any mesh."""
        return _FEWEST if self.ends is None else self.ends[0]

    @property
    def is_whole(self) -> bool:
        """True where the parameter is a whole number."""
        return self.ends is None or all(map(is_whole_number, self.ends))

    def search(self, limit: float, triangles: int, precision: float = PRECISION) -> Search:
        """Return the search for a mesh of some triangles that is to be within a limit of itself."""
        low, high = self.ends or (min(_FEWEST, triangles), triangles)
        coarser = False if self.parameter == _TRIANGLES else None
        return Search(limit, low, high, self.is_whole, coarser, precision)

    def source(self, size: float) -> Source:
        """Return the source of the mesh of one size; StudyError where its table is malformed."""
        value = int(size) if self.is_whole else size
        try:
            source = parse_source({**self.table, self.parameter: [value], "mesh": _ANY_MESH})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = "".join(f"{part}: " for part in first["loc"])
            raise StudyError(f"{place}{first['msg'].removeprefix('Value error, ')}") from error
        return source.with_cache(self.cache)

    def member(self, original: Member, size: float, triangles: int | None = None) -> Member | None:
        """Return the mesh of one size that is made of another one; None for that one itself, by its triangles."""
        if triangles is not None and self.parameter == _TRIANGLES and size >= triangles:
            return None
        source = self.source(size).model_copy(update={"mesh": GivenSource(member=original)})
        return single_member(source, Path.cwd())

    def fingerprint(self, original: Member) -> list[Any]:
        """Return what all meshes that are made of another one depend on; MeshError where that cannot be read."""
        member = self.member(original, self.a_size)
        return [self.parameter, self.ends, None if member is None else member.fingerprint()]
