"""A study: families of surfaces, a reference, a lattice, and orders."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import ValidationError

from sobolev_batch.batch.study.schema import (
    Backends,
    FamilyName,
    FamilyReferenceSection,
    StudyDocument,
    distinct_orders,
    explain,
    read_toml,
    require_modest,
)
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.dtypes import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, quoted
from sobolev_batch.surfaces.sources.registry import Source, parse_source

REFERENCE_LABEL = "reference"


@dataclass(frozen=True)
class Family:
    """A named source of surfaces."""

    name: str
    source: Source


@dataclass(frozen=True)
class FamilyReference:
    """A reference that is a member of one of the study's families: its finest unless named."""

    family: str
    member: str | None


@dataclass(frozen=True)
class Scaling:
    """Choice of the study's one similarity transform.

    "reference" takes the reference's bounding sphere to the unit sphere at the origin, "none" is the identity, and
    "fixed" is the given one.
    """

    mode: Literal["reference", "none", "fixed"]
    fixed: Similarity


@dataclass(frozen=True)
class Study:
    """A validated study. Make it by `from_toml` or `from_table`.

    Attributes:
        name: Word or line that identifies the study; a store remembers it.
        title: Free text.
        lattice: Lattice of all fields; None if an accuracy is asked for.
        octaves: Number of octaves that are sampled beyond a given lattice.
        accuracy: Accuracy of the distances to the reference; None if the lattice is given.
        transform: Accuracy, dtype and quadrature of the transforms.
        dtype: Dtype that was asked for, if any.
        backend: Backend of the transforms; "auto" leaves it to each worker.
        orders: Sobolev orders s < -1/2.
        pairs: "all" for the distances of all pairs of meshes, "reference" for those to the reference alone.
        families: Families of surfaces to compare.
        reference: Surface that they are compared with.
        scaling: Choice of the common unit of length.
        witness: Orders for which every mesh's witness function against the reference is stored, at its vertices;
            empty if none are asked for.
        proximity: Number of points that are drawn on each mesh for its Hausdorff and Chamfer distances from the
            reference; None if these are not asked for.
        folder: Folder in which relative paths start.
        table: The study as it was written.
        largest_chunk_bytes: Size above which a stored field is split into blocks, one chunk each.

    >>> import sobolev_batch as sb
    >>> study = sb.Study.from_table({
    ...     "study": {"name": "spheres"},
    ...     "lattice": {"xi_max": 2.0, "M": 8},
    ...     "norm": {"orders": [-2.0]},
    ...     "reference": {"source": "sphere"},
    ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
    ... })
    >>> study.orders, study.lattice, study.pairs
    ((-2.0,), Lattice(xi_max=2.0, M=8), 'all')
    """

    name: str
    title: str
    lattice: Lattice | None
    accuracy: Accuracy | None
    transform: TransformSettings
    dtype: ComplexDtype | None
    backend: Backends
    orders: tuple[float, ...]
    pairs: Literal["all", "reference"]
    families: tuple[Family, ...]
    reference: Source | FamilyReference
    scaling: Scaling
    witness: tuple[float, ...]
    proximity: int | None
    folder: Path
    table: Mapping[str, Any]
    largest_chunk_bytes: int = 256 << 20
    octaves: int = 0

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions that its surfaces need besides those that this package requires."""
        sources = [family.source for family in self.families]
        if isinstance(self.reference, Source):
            sources.append(self.reference)
        own = () if self.proximity is None else ("vtk",)
        return tuple(sorted({*own, *(library for source in sources for library in source.libraries)}))

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a study file. Relative paths in it start from its folder.

        Args:
            path: Path of the file. docs/studies.md describes its sections.

        Raises:
            StudyError: The file cannot be read, is not TOML, or has keys that are unknown, of the wrong type, or out
                of range. The message lists every offender.

        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> import sobolev_batch as sb
        >>> text = '''
        ... study.name = "spheres"
        ... lattice = { xi_max = 4.0, M = 32 }
        ... norm.orders = [-2.0, -3.0]
        ... reference.source = "sphere"
        ... family = [{ name = "ico", source = "icosphere", levels = [0, 1] }]
        ... '''
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "study.toml"
        ...     _ = path.write_text(text)
        ...     study = sb.Study.from_toml(path)
        >>> study.name, study.orders, study.lattice
        ('spheres', (-2.0, -3.0), Lattice(xi_max=4.0, M=32))
        """
        path = Path(path)
        try:
            return cls._of(read_toml(path), path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: Sections study, lattice or accuracy, norm, transform, reference, family (a list), scaling,
                witness, proximity.
            folder: Folder in which relative paths start.

        Raises:
            StudyError: See `from_toml`.

        >>> import sobolev_batch as sb
        >>> study = sb.Study.from_table({
        ...     "study": {"name": "spheres"},
        ...     "accuracy": {"rtol": 1e-3, "memory": "4GB"},
        ...     "norm": {"orders": [-2.0]},
        ...     "reference": {"source": "sphere"},
        ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
        ... })
        >>> [family.name for family in study.families], study.accuracy.rtol
        (['ico'], 0.001)
        """
        return cls._of(table, Path(folder))

    @classmethod
    def _of(cls, table: Mapping[str, Any], folder: Path) -> Self:
        require_modest(table)
        try:
            document = StudyDocument.model_validate(dict(table))
        except ValidationError as error:
            raise StudyError(explain(error)) from error
        if document.accuracy is not None and document.accuracy.memory_gb is not None:
            warnings.warn(
                "the key memory_gb of [accuracy] is now called memory, as in memory = "
                f'"{document.accuracy.memory_gb:g}GB"; memory_gb will be refused from the next release on',
                DeprecationWarning,
                stacklevel=3,
            )
        families = tuple(_family(i, entry) for i, entry in enumerate(document.family))
        _require_distinct(families)
        reference = _reference(document.reference, families)
        if isinstance(reference, Source):
            families = tuple(replace(family, source=family.source.with_reference(reference)) for family in families)
        try:
            orders = distinct_orders(document.norm.orders)
            return cls(
                name=document.study.name,
                title=document.study.title or document.study.name,
                lattice=None if document.lattice is None else document.lattice.settings(),
                accuracy=None if document.accuracy is None else document.accuracy.settings(),
                transform=document.transform.settings(),
                dtype=document.transform.dtype,
                backend=document.transform.backend,
                orders=orders,
                pairs=document.norm.pairs,
                families=families,
                reference=reference,
                scaling=_scaling(document),
                witness=() if document.witness is None else document.witness.settings(orders),
                proximity=None if document.proximity is None else document.proximity.points,
                folder=folder,
                octaves=0 if document.lattice is None else document.lattice.octaves,
                table=json.loads(json.dumps(table, default=str)),
            )
        except StudyError:
            raise
        except InputError as error:
            raise StudyError(str(error)) from error


def _require_distinct(families: tuple[Family, ...]) -> None:
    same = duplicate_names(family.name for family in families)
    if same:
        names = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
        raise StudyError(
            f"family: names must differ by more than case and the spelling of accents, found {names} twice; rename one"
        )
    if any(caseless_key(family.name) == REFERENCE_LABEL for family in families):
        raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")


def _family(index: int, entry: dict[str, Any]) -> Family:
    key = f"family {quoted(entry.get('name', index + 1))}"
    parameters = {name: value for name, value in entry.items() if name != "name"}
    try:
        name = FamilyName.model_validate({name: entry[name] for name in ("name",) if name in entry}).name
        return Family(name, parse_source(parameters))
    except ValidationError as error:
        raise StudyError(f"{key}: {explain(error)}") from error
    except InputError as error:
        raise StudyError(f"{key}: {error}") from error


def _reference(entry: dict[str, Any], families: tuple[Family, ...]) -> Source | FamilyReference:
    try:
        if entry.get("source") == "family":
            section = FamilyReferenceSection.model_validate({k: v for k, v in entry.items() if k != "source"})
            if section.family not in {family.name for family in families}:
                raise StudyError(f"no family is named {quoted(section.family)}")
            return FamilyReference(section.family, section.member)
        return parse_source(entry)
    except ValidationError as error:
        raise StudyError(f"reference: {explain(error)}") from error
    except InputError as error:
        raise StudyError(f"reference: {error}") from error


def _scaling(document: StudyDocument) -> Scaling:
    section = document.scaling
    scale = 1.0 if section.scale is None else section.scale
    return Scaling(section.mode, Similarity(scale, section.origin or (0.0, 0.0, 0.0)))
