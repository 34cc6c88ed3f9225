"""A study: families of surfaces, a reference, a lattice, and orders."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import ValidationError

from sobolev_batch.batch.study.refusals import joined, known_names, refusals, shown_value
from sobolev_batch.batch.study.schema import (
    Backends,
    FamilyReference,
    FamilySection,
    StudyDocument,
    plain_tables,
    read_toml,
    require_modest,
)
from sobolev_batch.errors import InputError, StudyError
from sobolev_batch.spectral.adaptive.tolerance import Accuracy
from sobolev_batch.spectral.backends.arrays import ComplexDtype
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.shells import check_orders
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.surfaces.shapes.surface import Similarity
from sobolev_batch.surfaces.sources.names import caseless_key, duplicate_names, quoted
from sobolev_batch.surfaces.sources.registry import Source, parse_source, source_type_of

REFERENCE_LABEL = "reference"


@dataclass(frozen=True)
class Family:
    """A named source of surfaces.

    Attributes:
        name: Name of the family.
        source: Source of its surfaces.
        order_by: What orders its meshes in tables, if the study says so: their triangles, or the natural order of their
            names, in which they are no sequence from coarse to fine and have no rates.
    """

    name: str
    source: Source
    order_by: Literal["triangles", "names"] | None = None


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
                proximity.
            folder: Folder in which relative paths start.

        A pandas.DataFrame may stand where a list of tables does, such as for ``meshes`` of the source ``files``.

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

    def with_best_effort(self) -> Study:
        """Return the study with the key ``best_effort`` of its accuracy set.

        Raises:
            StudyError: It has a lattice instead of an accuracy.

        >>> import sobolev_batch as sb
        >>> study = sb.Study.from_table({
        ...     "study": {"name": "spheres"},
        ...     "accuracy": {"rtol": 1e-3},
        ...     "norm": {"orders": [-0.6]},
        ...     "reference": {"source": "sphere"},
        ...     "family": [{"name": "ico", "source": "icosphere", "levels": [0, 1]}],
        ... })
        >>> study.with_best_effort().accuracy.best_effort
        True
        """
        if self.accuracy is None:
            raise StudyError("a best effort is made for an [accuracy]; this study has a [lattice]")
        return self.from_table(
            {**self.table, "accuracy": {**self.table["accuracy"], "best_effort": True}}, folder=self.folder
        )

    @classmethod
    def _of(cls, table: Mapping[str, Any], folder: Path) -> Self:
        if not isinstance(table, Mapping):
            raise StudyError(f"a study is a mapping of sections, such as {{'study': ...}}, found {shown_value(table)}")
        require_modest(table)
        values = plain_tables(table)
        # Families and the reference are looked at even where sections are wrong: all offenders are named.
        refused: list[str] = []
        document: StudyDocument | None = None
        try:
            document = StudyDocument.model_validate(values)
        except ValidationError as error:
            refused += refusals(error, values, StudyDocument)
        entries = values.get("family")
        tables = [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
        families = tuple(_families(tables, refused))
        reference = _reference(values.get("reference"), tables, refused)
        if document is None or reference is None or refused:
            raise StudyError(joined(refused))
        _require_distinct(families)
        if isinstance(reference, Source):
            families = tuple(replace(family, source=family.source.with_reference(reference)) for family in families)
        with _in_section("lattice"):
            lattice = None if document.lattice is None else document.lattice.settings()
        with _in_section("accuracy"):
            accuracy = None if document.accuracy is None else document.accuracy.settings()
        with _in_section("transform"):
            transform = document.transform.settings()
        with _in_section("scaling"):
            scaling = document.scaling.settings()
        orders = document.norm.orders
        return cls(
            name=document.study.name,
            title=document.study.title or document.study.name,
            lattice=lattice,
            accuracy=accuracy,
            transform=transform,
            dtype=document.transform.dtype,
            backend=document.transform.backend,
            orders=orders,
            pairs=document.norm.pairs,
            families=families,
            reference=reference,
            scaling=scaling,
            proximity=None if document.proximity is None else document.proximity.points,
            folder=folder,
            octaves=0 if document.lattice is None else document.lattice.octaves,
            table=json.loads(json.dumps(values, default=str)),
        )


@contextmanager
def _in_section(name: str) -> Iterator[None]:
    """Name the section whose values together are refused."""
    try:
        yield
    except InputError as error:
        raise StudyError(f"[{name}]: {error}") from error


def _require_distinct(families: tuple[Family, ...]) -> None:
    same = duplicate_names(family.name for family in families)
    if same:
        names = ", ".join(quoted(name) for group in same[:3] for name in group[:3])
        raise StudyError(
            f"family: names must differ by more than case and the spelling of accents, found {names} twice; rename one"
        )
    if any(caseless_key(family.name) == REFERENCE_LABEL for family in families):
        raise StudyError(f"family: no family can be named {REFERENCE_LABEL!r}: it is the label of the reference")


def _families(entries: list[dict[str, Any]], refused: list[str]) -> Iterator[Family]:
    """Yield the families that can be read, and add what is wrong with the others to the refusals."""
    for number, entry in enumerate(entries, 1):
        place = f"[[family]] {number}"
        if isinstance(entry.get("name"), str):
            place += f" (named {quoted(entry['name'])})"
        own = {key: entry[key] for key in FamilySection.model_fields if key in entry}
        section = None
        try:
            section = FamilySection.model_validate(own)
        except ValidationError as error:
            refused += refusals(error, entry, FamilySection, place)
        parameters = {key: value for key, value in entry.items() if key not in own}
        source = _source(parameters, place, refused, FamilySection.model_fields)
        if section is not None and source is not None:
            yield Family(section.name, source, section.order_by)


def _source(parameters: dict[str, Any], place: str, refused: list[str], others: Iterable[str] = ()) -> Source | None:
    """Return the source of a table, or add what is wrong with it to the refusals."""
    try:
        return parse_source(parameters)
    except ValidationError as error:
        refused += refusals(error, parameters, source_type_of(parameters["source"]), place, tuple(others))
    except InputError as error:
        refused.append(f"{place}: {error}")
    return None


def _reference(entry: object, families: list[dict[str, Any]], refused: list[str]) -> Source | FamilyReference | None:
    """Return the reference, or add what is wrong with it to the refusals."""
    if not isinstance(entry, dict):
        return None
    place = "[reference]"
    if entry.get("source") != "family":
        return _source(entry, place, refused)
    parameters = {key: value for key, value in entry.items() if key != "source"}
    try:
        reference = FamilyReference.model_validate(parameters)
    except ValidationError as error:
        refused += refusals(error, parameters, FamilyReference, place, ("source",))
        return None
    names, name = [str(family.get("name")) for family in families], reference.family
    if name not in names:
        refused.append(f"{place}: no family is named {quoted(name)}; {known_names(name, names)}")
        return None
    return reference
