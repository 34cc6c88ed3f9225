"""Where meshes come from: sources, their members, and the registry that finds sources by name.

A source is a validated description (the parameters of a family in a study file). It lists its
members without computing anything; a member is a small value that travels to a worker and is made
into a surface there. Other packages add sources through the entry point group
``sobolev_batch.sources``: each names a subclass of `Source`.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, SerializeAsAny, field_validator

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.formats.contents import bounded_length, open_regular
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.names import shown

# Of levels, or of triangle counts of one mesh.
MOST_ENTRIES = 1000

_GROUP = "sobolev_batch.sources"

Fingerprint = Mapping[str, Any]


class Source(BaseModel, ABC):
    """Parameters of a family of surfaces. Subclasses add fields; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that making its surfaces takes, besides those that this package requires."""
        return ()

    @abstractmethod
    def members(self, folder: Path) -> tuple[Member, ...]:
        """The surfaces of the family, from coarse to fine where that has a meaning.

        Args:
            folder: where relative paths start; that of the study file.

        Raises:
            StudyError: the parameters lead to no surface.
        """


@dataclass(frozen=True)
class Size:
    """How large a surface is going to be, told without making it.

    Attributes:
        triangles: about how many; 0 for a closed form.
        making_bytes: about the memory that making it takes at its peak.
    """

    triangles: int = 0
    making_bytes: float = 0.0


@dataclass(frozen=True)
class Member(ABC):
    """One surface of a source.

    Attributes:
        name: unique within its source; labels the surface in the store.
        level: the refinement level, or the rank from coarse to fine; -1 where there is no such order.
    """

    name: str
    level: int

    @abstractmethod
    def load(self) -> Surface:
        """Make the surface, in its own unit of length.

        Raises:
            MeshError: it cannot be read or made.
        """

    @abstractmethod
    def fingerprint(self) -> Fingerprint:
        """JSON-able values that determine the surface: the contents of files, not their names.

        Two equal fingerprints promise equal surfaces, so a stored field can be taken over.

        Raises:
            MeshError: a file that it depends on cannot be read.
        """

    def fingerprint_digest(self) -> str:
        """SHA-256 of the fingerprint.

        Raises:
            MeshError: as for `fingerprint`.
        """
        return hashlib.sha256(json.dumps(self.fingerprint(), sort_keys=True).encode()).hexdigest()

    def expected_size(self) -> Size:
        """What the surface and its making are going to take; what cannot be told counts as nothing.

        Meshes of millions of triangles are cut into parts, and too large ones are refused, on the
        strength of this.
        """
        return Size()


def at_most(count: int) -> BeforeValidator:
    """A bound on the length of a list, looked at before its entries are."""

    def check(value: object) -> object:
        if isinstance(value, list | tuple) and len(value) > count:
            raise ValueError(f"at most {count} entries are allowed, found {len(value)}")
        return value

    return BeforeValidator(check)


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        MeshError: the file cannot be read.
    """
    try:
        with open_regular(path) as file:
            bounded_length(file)
            return hashlib.file_digest(file, "sha256").hexdigest()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def installed_version(distribution: str) -> str:
    """The installed version of a library whose output is part of a surface.

    Raises:
        MeshError: it is not installed.
    """
    try:
        return version(distribution)
    except PackageNotFoundError as error:
        raise MeshError(
            f"this source needs the library {distribution}, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[studies]'"
        ) from error


class NestedSource(Source):
    """A source that works on the one surface of another.

    Attributes:
        mesh: the table of the other source.
    """

    mesh: SerializeAsAny[Source]

    @property
    def libraries(self) -> tuple[str, ...]:
        """Those of the other source."""
        return self.mesh.libraries

    @field_validator("mesh", mode="before")
    @classmethod
    def _parse_mesh(cls, table: object) -> object:
        if not isinstance(table, dict):
            raise ValueError('must be a table that names a source, such as { source = "files", paths = ["a.ply"] }')
        return parse_source(table)


def parse_source(table: Mapping[str, Any]) -> Source:
    """Look a source up by the table's ``source`` key and validate the other keys as its parameters.

    Args:
        table: the parameters of a family or reference, as read from TOML.

    Raises:
        StudyError: no such source.
        pydantic.ValidationError: parameters that it does not take.
    """
    name = table.get("source")
    registry = _registry()
    if not isinstance(name, str) or name not in registry:
        raise StudyError(f"no source is named {shown(name)}; known are {', '.join(sorted(registry))}")
    try:
        source_type = registry[name].load()
    except (ImportError, AttributeError) as error:
        raise StudyError(f"the source {name!r} cannot be loaded: {error}") from error
    if not (isinstance(source_type, type) and issubclass(source_type, Source)):
        raise StudyError(f"the entry point of the source {name!r} is not a subclass of Source: {registry[name].value}")
    parameters = {key: value for key, value in table.items() if key != "source"}
    return source_type.model_validate(parameters)


def sole_member(source: Source, folder: Path) -> Member:
    """The member of a source that must have exactly one.

    Raises:
        StudyError: it has none or several.
    """
    members = source.members(folder)
    if len(members) != 1:
        names = ", ".join(member.name for member in members[:5])
        raise StudyError(f"exactly one surface is needed here, but the source makes {len(members)}: {names}")
    return members[0]


@lru_cache(maxsize=1)
def _registry() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=_GROUP)}
