"""A study: families of surfaces, a reference, a lattice, and orders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

from sobolev_batch.batch.study.schema import (
    Backends,
    Family,
    FamilyReference,
    StudyDocument,
    known_names,
    plain_tables,
    read_toml,
)
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.surface import Similarity
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, quoted
from sobolev_batch.surfaces.sources.registry import Source

REFERENCE_LABEL = "reference"


@dataclass(frozen=True)
class Study:
    """A validated study. Make it by `from_toml` or `from_table`.

    Attributes:
        name: Word or line that identifies the study; a store remembers it.
        title: Free text.
        lattice: Lattice of all fields; None if an accuracy is requested.
        octaves: Number of octaves that are sampled beyond a given lattice.
        accuracy: Accuracy of the distances to the reference; None if the lattice is given.
        transform: Accuracy, dtype and quadrature of the transforms.
        dtype: Dtype that was requested, if any.
        backend: Backend of the transforms; "auto" leaves it to each worker.
        orders: Sobolev orders s < -1/2.
        pairs: "all" for the distances of all pairs of meshes, "reference" for those to the reference alone.
        families: Families of surfaces to compare.
        reference: Surface that they are compared with.
        scaling: Similarity transform of all surfaces; None takes the reference's bounding sphere to the unit sphere.
        proximity: Number of points that are drawn on each mesh for its Hausdorff and Chamfer distances from the
            reference; None if these are not requested.
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
    scaling: Similarity | None
    proximity: int | None
    folder: Path
    table: Mapping[str, Any]
    largest_chunk_bytes: int = 256 << 20
    octaves: int = 0

    def __post_init__(self) -> None:
        check_orders(self.orders)

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
            StudyError: The file cannot be read, is no TOML, or has keys that are unknown, of the wrong type, or out of
                range. The message lists every offender.
        """
        path = Path(path)
        try:
            return cls.from_table(read_toml(path), folder=path.parent)
        except InputError as error:
            raise StudyError(f"{path}: {error}") from error

    @classmethod
    def from_table(cls, table: Mapping[str, Any], *, folder: str | Path = ".") -> Self:
        """Validate a study given as nested tables, with the keys of the study file.

        Args:
            table: Sections of the study file. A pandas.DataFrame may take the place of a list of tables, such as for
                ``meshes`` of the source ``files``.
            folder: Folder in which relative paths start.

        Raises:
            StudyError: See `from_toml`.
        """
        values = plain_tables(table)
        document = StudyDocument.from_tables(values)
        if document.object is not None or document.objects:
            raise StudyError("[[object]] and [objects] make several studies; read them as a StudyCollection")
        families, reference = document.family, document.reference
        if not families:
            raise StudyError("[[family]] must have at least 1 item, found []")
        if reference is None:
            raise StudyError("[reference] must be a table, found None")
        names = [family.name for family in families]
        _require_distinct(names)
        if isinstance(reference, FamilyReference):
            if reference.family not in names:
                hint = known_names(reference.family, names)
                raise StudyError(f"[reference]: no family is named {quoted(reference.family)}; {hint}")
        else:
            sources = [family.source.with_reference(reference) for family in families]
            families = [one.model_copy(update={"source": s}) for one, s in zip(families, sources, strict=True)]
        return cls(
            name=document.study.name,
            title=document.study.title or document.study.name,
            lattice=None if document.lattice is None else document.lattice.settings(),
            accuracy=None if document.accuracy is None else document.accuracy.settings(),
            transform=document.transform.settings(),
            dtype=document.transform.dtype,
            backend=document.transform.backend,
            orders=document.norm.settings(),
            pairs=document.norm.pairs,
            families=tuple(families),
            reference=reference,
            scaling=document.scaling.settings(),
            proximity=None if document.proximity is None else document.proximity.points,
            folder=Path(folder),
            octaves=document.lattice.octaves if document.lattice else 0,
            table=json.loads(json.dumps(values, default=str)),
        )

    def with_best_effort(self) -> Study:
        """Return the study with the key ``best_effort`` of its accuracy set.

        Raises:
            StudyError: It has a lattice instead of an accuracy.
        """
        if self.accuracy is None:
            raise StudyError("a best effort is made for an [accuracy]; this study has a [lattice]")
        table = {**self.table, "accuracy": {**self.table["accuracy"], "best_effort": True}}
        return replace(self, accuracy=replace(self.accuracy, best_effort=True), table=table)


def _require_distinct(families: Sequence[str]) -> None:
    same = duplicate_names(families)
    if same:
        names = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
        raise StudyError(
            f"family: names must differ by more than case and the spelling of accents, found {names} twice; rename one"
        )
    if any(caseless_key(name) == REFERENCE_LABEL for name in families):
        raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")
