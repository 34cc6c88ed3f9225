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
from sobolev_batch.reduction.search import MOST_TRIALS, PRECISION, Search
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.programs import INPUT, OUTPUT, PLACEHOLDER
from sobolev_batch.sources.registry import Member, Source, parse_source, single_member

# What a remesher is asked for by default, and the fewest triangles of a closed mesh.
_TRIANGLES, _FEWEST = "triangles", 4
# Stands for the mesh of a source until that is given.
_ANY_MESH = {"source": "icosphere", "levels": [0]}

# The name of a source, a command, a function of a mesh, or the table of a family without its mesh.
Method = str | Callable[..., Any] | Mapping[str, Any]


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
    def parse(cls, method: Method, search: Mapping[str, tuple[float, float]] | None = None) -> Self:
        """Return the remesher that is meant; InputError where none is, or its parameter has no range to search."""
        if isinstance(method, Mapping):
            table = dict(method)
        elif callable(method):
            table = {"source": "function", "function": method}
        elif words := (shlex.split(method) if PLACEHOLDER.search(method) else []):
            table = {"source": "command", "command": words}
        else:
            table = {"source": method}
        asked = {name for word in table.get("command", ()) for name in PLACEHOLDER.findall(word)} - {INPUT, OUTPUT}
        parameters: dict[str, Any] = dict(search or {}) or {_TRIANGLES: None}
        if len(parameters) != 1:
            raise InputError(f"one parameter is searched, found {', '.join(parameters)}; give the others fixed values")
        ((name, ends),) = parameters.items()
        if search is None and asked and name not in asked:
            example = f"{min(asked)}=0.001:1.0"
            raise InputError(f"the command has no {{{name}}}; say between which values to search, such as {example}")
        if ends is not None and (not isinstance(ends, list | tuple) or len(ends) != 2):
            raise InputError(f"{name} is searched between two values, such as (0.001, 1.0), found {ends!r}")
        remesher = cls(table, name, None if ends is None else (ends[0], ends[1]))
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

    def search(
        self, limit: float, triangles: int, precision: float = PRECISION, most_trials: int = MOST_TRIALS
    ) -> Search:
        """Return the search for a mesh of some triangles that is to be within a limit of itself."""
        low, high = self.ends or (min(_FEWEST, triangles), triangles)
        coarser = False if self.parameter == _TRIANGLES else None
        return Search(limit, low, high, self.is_whole, coarser, precision, most_trials)

    def source(self, size: float) -> Source:
        """Return the source of the mesh of one size; StudyError where its table is malformed."""
        value = int(size) if self.is_whole else size
        try:
            source = parse_source({**self.table, self.parameter: [value], "mesh": _ANY_MESH})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            message = first["msg"].removeprefix("Value error, ")
            raise StudyError(": ".join(filter(None, (".".join(map(str, first["loc"])), message)))) from error
        return source.with_cache(self.cache)

    def member(self, original: Member, size: float) -> Member:
        """Return the mesh of one size that is made of another one."""
        source = self.source(size).model_copy(update={"mesh": GivenSource(member=original)})
        return single_member(source, Path.cwd())

    def keeps(self, size: float, triangles: int) -> bool:
        """Tell whether a size is that of a mesh itself, which then need not be made."""
        return self.parameter == _TRIANGLES and size >= triangles
