"""Sources of surfaces, their members, and the registry that finds sources by name.

A source is a validated description: the parameters of a family in a study file. It lists its members without computing
anything. A member is a small value that travels to a worker, which makes the surface. Other packages add sources
through the entry point group ``sobolev_batch.sources``; each entry point names a subclass of `Source`.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.metadata import EntryPoint, version
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, SerializeAsAny

from sobolev_batch.errors import MeshError, StudyError, from_extra, naming
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface, is_finite_number
from sobolev_batch.plugins import SOURCES, registered
from sobolev_batch.sources.mesh_cache import InMemory, MeshCache
from sobolev_batch.sources.names import known_names, quoted
from sobolev_batch.sources.programs import Cost

# Levels, or triangle counts of one mesh, that one source takes; and times.
MOST_ENTRIES, _MOST_TIMES = 1000, 100_000

_EXAMPLE = '{ source = "files", paths = ["a.ply"] }'
# How to give a mesh that is missing.
MESH_HINT = f"give one, such as mesh = {_EXAMPLE}"

# The sources of this folder, by name.
_OWN = {
    "command": "command:CommandSource",
    "decimate": "derived:DecimateSource",
    "ellipsoid": "generated:EllipsoidSource",
    "files": "files:FileSource",
    "flow": "derived:FlowSource",
    "function": "command:FunctionSource",
    "icosphere": "generated:IcosphereSource",
    "remesh": "derived:RemeshSource",
    "sphere": "generated:SphereSource",
    "spherical-levels": "derived:SphericalLevelsSource",
    "torus": "generated:TorusSource",
}

Fingerprint = Mapping[str, Any]
Metadata = tuple[tuple[str, float | str], ...]


class Source(BaseModel, ABC):
    """The parameters of a family of surfaces. Subclass it to add a source of your own.

    A subclass adds pydantic fields, one for each key of the family's table in a study file, and `members`. Values are
    frozen, their types are strict and unknown keys are refused. The entry point group ``sobolev_batch.sources`` makes
    the subclass known; `check_source` tests it. docs/surfaces.md has a whole package.

    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> class StretchedBalls(sb.sources.Source):
    ...     sizes: list[float]
    ...
    ...     def members(self, folder: Path) -> tuple[sb.sources.Member, ...]:
    ...         balls = {size: sb.shapes.Ellipsoid((size, 1.0, 1.0)) for size in sorted(self.sizes)}
    ...         return tuple(
    ...             sb.sources.SurfaceMember(f"{size:g}", rank, ball, {"stretched ball": size})
    ...             for rank, (size, ball) in enumerate(balls.items())
    ...         )
    >>> [member.name for member in StretchedBalls(sizes=[2.0, 1.5]).members(Path())]
    ['1.5', '2']
    >>> sb.sources.check_source(StretchedBalls(sizes=[2.0, 1.5]))
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that the surfaces need, besides those that sobolev-batch requires."""
        return tuple(library for source in self._nested().values() for library in source.libraries)

    @property
    def commands(self) -> tuple[str, ...]:
        """Commands that making the surfaces runs, as a shell would have them."""
        return tuple(command for source in self._nested().values() for command in source.commands)

    @property
    def keeps_meshes(self) -> bool:
        """True if making the surfaces takes long, so that they are kept."""
        return any(source.keeps_meshes for source in self._nested().values())

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the source with the place where meshes are kept that take long to make.

        Args:
            cache: The place; it also says whether commands may run.
        """
        return self.model_copy(update={name: source.with_cache(cache) for name, source in self._nested().items()})

    def with_reference(self, reference: Source) -> Source:
        """Return the source for a study with a reference. Override it if the surfaces depend on that.

        Args:
            reference: Source of the study's reference.
        """
        nested = {name: source.with_reference(reference) for name, source in self._nested().items()}
        return self.model_copy(update=nested)

    def _nested(self) -> dict[str, Source]:
        """Return the sources within this one, by their fields; each is handed what this one is handed."""
        return {name: value for name, value in self if isinstance(value, Source)}

    @abstractmethod
    def members(self, folder: Path) -> tuple[Member, ...]:
        """List the surfaces of the family, from coarse to fine where that has a meaning.

        Args:
            folder: Folder of the study file, where relative paths start.

        Returns:
            The same members each time, listed without making a surface.

        Raises:
            StudyError: The parameters lead to no surface.
        """


@dataclass(frozen=True)
class ExpectedSize:
    """The predicted size of a surface.

    Attributes:
        triangles: Approximate number of triangles; 0 for a closed form.
        projected_bytes: Approximate peak of the memory that `Member.load` takes.
        seconds: Approximate processor time that `Member.load` takes, where it does more than read or tile.
        is_known: False where nothing is known of the triangles before the surface is made.

    >>> import sobolev_batch as sb
    >>> sb.sources.ExpectedSize(triangles=20_480, projected_bytes=3e6).triangles
    20480
    """

    triangles: int = 0
    projected_bytes: float = 0.0
    seconds: float = 0.0
    is_known: bool = True


@dataclass(frozen=True)
class Member(ABC):
    """One surface of a source: a small, picklable value that a worker makes into the surface.

    A subclass is a frozen dataclass. It adds the fields from which it makes the surface.

    Attributes:
        name: Label of the surface in the store, unique within its source.
        level: Refinement level, or rank from coarse to fine; -1 where the source has no such order.
        time: Time of the surface, in a unit of the user's choice; None where the source has no time.
        metadata: Numbers and texts that the user knows of the surface, by their names; tables repeat them.
        is_quickly_loaded: True for a class whose surfaces are read, not made: a plan may look at many of them.

    >>> from dataclasses import dataclass
    >>> import sobolev_batch as sb
    >>> @dataclass(frozen=True)
    ... class TorusMember(sb.sources.Member):
    ...     cells: int
    ...
    ...     def load(self) -> sb.Mesh:
    ...         return sb.shapes.Torus().mesh(2 * self.cells, self.cells)
    ...
    ...     def fingerprint(self) -> dict[str, int]:
    ...         return {"torus of cells": self.cells}
    ...
    ...     def expected_size(self) -> sb.sources.ExpectedSize:
    ...         return sb.sources.ExpectedSize(4 * self.cells**2, 600.0 * self.cells**2)
    >>> TorusMember("coarse", 0, cells=6).load()
    Mesh(72 vertices, 144 triangles)
    """

    name: str
    level: int
    time: float | None = field(default=None, kw_only=True)
    metadata: Metadata = field(default=(), kw_only=True)
    is_quickly_loaded: ClassVar[bool] = False

    @property
    def names_wishes(self) -> bool:
        """True where the metadata say what was wanted of a program, beside which a table has what came of it."""
        return False

    @abstractmethod
    def load(self) -> Surface:
        """Make the surface, in its own unit of length. The result is the same each time.

        Raises:
            MeshError: The surface cannot be read or made.
        """

    def pilot(self) -> Surface:
        """Return what decides on the lattice of a study: the surface, or one much like it that is made sooner."""
        return self.load()

    @abstractmethod
    def fingerprint(self) -> Fingerprint:
        """Return JSON-able values that determine the surface: contents of files rather than their names.

        A run takes a stored field over where the fingerprint is the same. So equal fingerprints promise equal surfaces;
        include the versions of libraries and a number that you raise with each change of a formula.

        Raises:
            MeshError: A file that the surface depends on cannot be read.
        """

    def fingerprint_digest(self) -> str:
        """Return the SHA-256 of the fingerprint.

        Raises:
            MeshError: As for `fingerprint`.
        """
        return digest_of(self.fingerprint())

    def expected_size(self) -> ExpectedSize:
        """Predict the size of the surface and the memory that `load` takes, without making it.

        Meshes of millions of triangles are computed in batches, and meshes that fit into no worker are
        refused, by this prediction. The default predicts a small surface.
        """
        return ExpectedSize()

    def cost(self) -> Cost | None:
        """Return what making the surface took, where that is recorded."""
        return None

    def remark(self) -> str:
        """Return what one should know of how the surface was made; empty where that is nothing."""
        return ""


@dataclass(frozen=True)
class SurfaceMember(Member):
    """A member that carries its surface, for surfaces given by a few numbers or by functions of a module.

    Attributes:
        surface: The surface, which must survive pickling.
        identity: Fingerprint: the name of the formula, its parameters, and the version of what makes it.

    >>> import sobolev_batch as sb
    >>> sb.sources.SurfaceMember("ball", -1, sb.shapes.Sphere(2.0), {"ball": 2.0}).load()
    Sphere(radius=2.0, center=(0.0, 0.0, 0.0))
    """

    surface: Surface
    identity: Fingerprint
    is_quickly_loaded: ClassVar[bool] = True

    def load(self) -> Surface:
        """Return the surface."""
        return self.surface

    def fingerprint(self) -> Fingerprint:
        """Return the identity."""
        return self.identity


@dataclass(frozen=True)
class MadeMember(Member):
    """A mesh that a function makes, from the meshes of other members or from numbers alone.

    Attributes:
        make: Function of a module; it takes the meshes of the originals, then the arguments.
        identity: Rest of the fingerprint, beside originals and libraries: name of the formula, parameters, version.
        originals: Members whose meshes the function takes, by their keys in the fingerprint.
        libraries: Distributions whose versions are part of the fingerprint.
        triangles: Number of triangles of the mesh; None for as many as the first original has.
        triangle_bytes: Measured peak of the memory of making, for each triangle of the first original, or of the mesh.
        triangle_seconds: Measured time of making, for each triangle of the mesh.
    """

    make: Callable[..., Mesh]
    identity: Fingerprint
    arguments: tuple[Any, ...] = ()
    originals: Mapping[str, Member] = field(default_factory=dict)
    libraries: tuple[str, ...] = ()
    triangles: int | None = None
    triangle_bytes: int = 0
    triangle_seconds: float = 0.0

    def load(self) -> Mesh:
        """Make the mesh."""
        return self.make(*map(load_mesh, self.originals.values()), *self.arguments)

    def fingerprint(self) -> Fingerprint:
        """Return the identity, the fingerprints of the originals and the versions of the libraries."""
        return {
            **self.identity,
            **{key: dict(original.fingerprint()) for key, original in self.originals.items()},
            **{library: installed_version(library) for library in self.libraries},
        }

    def expected_size(self) -> ExpectedSize:
        """Return the number of triangles, and what it takes to make them, the first original included."""
        first = next(iter(self.originals.values()), None)
        size = ExpectedSize(self.triangles or 0) if first is None else first.expected_size()
        size = replace(size, projected_bytes=max(size.projected_bytes, float(self.triangle_bytes * size.triangles)))
        if self.triangles is not None:
            size = replace(size, triangles=self.triangles, is_known=True)
        return replace(size, seconds=size.seconds + self.triangle_seconds * size.triangles)


def digest_of(values: Any) -> str:
    """Return the SHA-256 of JSON-able values; their order in mappings does not matter."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def at_most(count: int) -> BeforeValidator:
    """Return a validator that bounds the length of a list before its entries are validated."""

    def check(value: object) -> object:
        if isinstance(value, list | tuple) and len(value) > count:
            raise ValueError(f"at most {count} entries are allowed, found {len(value)}")
        return value

    return BeforeValidator(check)


_Entry = TypeVar("_Entry")
# One or several numbers that each make a surface.
Several = Annotated[tuple[_Entry, ...], Field(min_length=1, strict=False), at_most(MOST_ENTRIES)]


def checked_times(value: object) -> tuple[float, ...]:
    """Return a list of different times as floats; ValueError where it is none."""
    if not isinstance(value, list | tuple) or not value:
        raise ValueError("must be a list of numbers, such as [0.0, 0.5, 1.0]")
    if len(value) > _MOST_TIMES:
        raise ValueError(f"at most {_MOST_TIMES} entries are allowed, found {len(value)}")
    if wrong := [time for time in value if not is_finite_number(time)]:
        raise ValueError(f"each time must be a finite number, found {quoted(wrong[0])} among them")
    times = tuple(map(float, value))
    if repeated := sorted(time for time, count in Counter(times).items() if count > 1):
        raise ValueError(f"each time can be there once, found {repeated[0]:g} again")
    return times


# One or several different times, for sources of surfaces that move.
Times = Annotated[tuple[float, ...], BeforeValidator(checked_times)]


def parse_source(table: Mapping[str, Any]) -> Source:
    """Return the source that the key ``source`` of a table names, with the other keys as its parameters."""
    if "source" not in table:
        raise StudyError('source is missing; add it, such as source = "files"')
    source_type = source_type_of(table["source"])
    return source_type.model_validate({key: value for key, value in table.items() if key != "source"})


def _parse_nested(table: object) -> Source:
    if not isinstance(table, dict):
        raise ValueError(f"must be a table that names a source, such as {_EXAMPLE}")
    with naming(f"the table {quoted(table)}"):
        return parse_source(table)


# A source within the table of another one.
OtherSource = Annotated[SerializeAsAny[Source], BeforeValidator(_parse_nested)]


class _OfReference(Source):
    """A stand-in for the reference of a study until that is known."""

    def with_reference(self, reference: Source) -> Source:
        return reference

    def members(self, folder: Path) -> tuple[Member, ...]:
        raise StudyError(f"mesh is missing, and no reference can take its place; {MESH_HINT}")


class NestedSource(Source):
    """A source that works on the surfaces of another one: that of its key ``mesh``, by default a study's reference."""

    mesh: OtherSource = Field(default_factory=_OfReference)


class KeepingSource(Source):
    """A source whose meshes take long to make, so that they are kept; in memory until it is given a place for them."""

    _cache: MeshCache = PrivateAttr(default_factory=lambda: MeshCache(InMemory()))

    @property
    def keeps_meshes(self) -> bool:
        """True: all of its meshes are kept."""
        return True

    def with_cache(self, cache: MeshCache) -> Self:
        """Return the source with the place of its meshes."""
        source = super().with_cache(cache)
        source._cache = cache
        return source


def source_type_of(name: object) -> type[Source]:
    """Return the source of a name; StudyError where there is none, or it cannot be loaded."""
    registry = sources_by_name()
    if not isinstance(name, str) or name not in registry:
        hint = known_names(name if isinstance(name, str) else "", sorted(registry))
        raise StudyError(f"no source is named {quoted(name)}; {hint}")
    try:
        source_type = registry[name].load()
    except (ImportError, AttributeError) as error:
        raise StudyError(f"the source {name!r} cannot be loaded: {error}") from error
    if not (isinstance(source_type, type) and issubclass(source_type, Source)):
        raise StudyError(f"the entry point of the source {name!r} is not a subclass of Source: {registry[name].value}")
    return source_type


def single_member(source: Source, folder: Path) -> Member:
    """Return the only member of a source; StudyError where it has none or several."""
    members = source.members(folder)
    if len(members) != 1:
        names = ", ".join(member.name for member in members[:5])
        raise StudyError(f"exactly one surface is needed here, but the source makes {len(members)}: {names}")
    return members[0]


def load_mesh(member: Member) -> Mesh:
    """Return the surface of a member that must be a mesh; MeshError where it is none, or cannot be made."""
    mesh = member.load()
    if not isinstance(mesh, Mesh):
        raise MeshError(f"{member.name} is no mesh; its triangles are needed, so take a source of meshes")
    return mesh


def installed_version(distribution: str) -> str:
    """Return the version of a library whose output is part of a surface; MeshError where it is not installed."""
    with from_extra("studies", "this source needs", MeshError):
        return version(distribution)


@lru_cache(maxsize=1)
def sources_by_name() -> dict[str, EntryPoint]:
    """Return where each source is loaded from, those of other packages among them."""
    own = [EntryPoint(name, f"{__package__}.{value}", SOURCES) for name, value in _OWN.items()]
    # The first one that has a name keeps it.
    return {point.name: point for point in reversed((*own, *registered(SOURCES)))}
