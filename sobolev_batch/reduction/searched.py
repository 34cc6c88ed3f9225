"""Families of meshes as coarse as tolerances permit: each member is a search, which its task carries out."""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationInfo

from sobolev_batch.errors import InputError, MeshError, StudyError, refused_by_pydantic
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.reduction.limit import Limit, tried
from sobolev_batch.reduction.recorded import RecordedSearch, SearchRecord
from sobolev_batch.reduction.remesher import Remesher, searched_parameter
from sobolev_batch.sources.files import number_as_text
from sobolev_batch.sources.names import quoted
from sobolev_batch.sources.programs import Cost
from sobolev_batch.sources.registry import ExpectedSize, KeepingSource, Member, Several, Source, single_member

# One or several tolerances, as a study file gives them; and the parameter that is searched, with its ends.
Tolerances = Annotated[
    Several[float | str], BeforeValidator(lambda value: value if isinstance(value, list | tuple) else [value])
]
Searched = dict[str, Annotated[tuple[int | float, int | float], Field(strict=False)]]


def _template(table: Any, info: ValidationInfo) -> Source:
    with refused_by_pydantic():
        return Remesher.parse(table, info.data.get("search")).source


class SearchedSource(KeepingSource):
    """Meshes of one other mesh, of as few triangles as each of several tolerances permits.

    Attributes:
        within: Largest distances from the reference, as `Limit.parse` takes them with the order and the measure.
        search: Name of the parameter, and between which two values to search; None for triangles.
        template: Source that makes them, from its table without its mesh and the parameter that is searched.
        mesh: Mesh to start from; None for the reference.
        unit: Unit of the files, where it is known.
        default_order: Order of fractions for which none is given.
    """

    within: Tolerances
    order: float | None = None
    measure: str | None = None
    search: Searched | None = None
    template: Annotated[SerializeAsAny[Source], BeforeValidator(_template)]
    mesh: SerializeAsAny[Source] | None = None
    reference: SerializeAsAny[Source] | None = None
    unit: str | None = None
    default_order: float = DEFAULT_ORDER

    def with_reference(self, reference: Source) -> Source:
        """Return the source for a study with a reference."""
        return super().with_reference(reference).model_copy(update={"reference": reference})

    def in_study(self, unit: str | None, default_order: float) -> Self:
        """Return the source for a study with a unit and a first order; StudyError where tolerances are none."""
        source = self.model_copy(update={"unit": unit, "default_order": default_order})
        try:
            source.limits()
        except InputError as error:
            raise StudyError(f"within: {error}") from error
        return source

    def limits(self) -> dict[str, Limit]:
        """Return the tolerances by their names; InputError where they are none."""
        texts = [number_as_text(one) if isinstance(one, float) else one.strip() for one in self.within]
        limits = [Limit.parse(text, self.order, self.unit, self.measure, self.default_order) for text in texts]
        if same := [text for text, limit in zip(texts, limits, strict=True) if limits.count(limit) > 1]:
            raise InputError(f"the tolerances {quoted(same[0])} and {quoted(same[1])} are equal; remove one")
        return {text.replace(" ", ""): limit for text, limit in zip(texts, limits, strict=True)}

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each tolerance, in their order."""
        if self.reference is None:
            raise StudyError("within: the reference is a member of a family; give it a source of its own, or a mesh")
        reference = single_member(self.reference, folder)
        original = reference if self.mesh is None else single_member(self.mesh, folder)
        parameter, ends = searched_parameter(self.search)
        remesher = Remesher(self.template, parameter, ends, folder.absolute())
        members, may_search = [], self._cache.may_run and self._cache.may_search
        for name, limit in self.limits().items():
            search = RecordedSearch(original, reference, limit, remesher, self._cache.folder)
            metadata = ("target_tolerance", limit.value), ("target_measure", limit.measure)
            members.append(SearchedMember(name, -1, search, may_search, metadata=metadata))
        return tuple(members)


@dataclass(frozen=True)
class SearchedMember(Member):
    """The mesh of fewest triangles that a search finds, unless it was found before, or may not run."""

    search: RecordedSearch
    may_search: bool

    def load(self) -> Mesh:
        """Return the mesh that is kept, or go on with the search; MeshError where it finds none, or may not run."""
        search, record = self.search, self.search.recorded()
        if not self.may_search and (record is None or search.next(record)):
            raise MeshError(f"no search may run here, and its mesh is not kept in {search.folder}; run the study")
        record = record or search.begun()
        while sizes := search.next(record):
            record = search.taken(record, tried(*search.trial(record, sizes[0])))
        if reason := search.reason(record):
            raise MeshError(reason)
        return search.mesh(record)

    def pilot(self) -> Surface:
        """Return the mesh that is found, or the one that a search would try next where none may run."""
        if not self.may_search:
            record = self.search.recorded() or self.search.begun()
            if sizes := self.search.next(record):
                return self.search.trial(record, sizes[0])[1].load()
        return self.load()

    def cost(self) -> Cost | None:
        """Return what all trials took, as far as that is known."""
        return None if (record := self._recorded()) is None else Cost(sum(one.seconds for one in record.trials))

    def remark(self) -> str:
        """Return what one should know of what was found, as far as that is known."""
        return "" if (record := self._recorded()) is None else "; ".join(self.search.remarks(record))

    def _recorded(self) -> SearchRecord | None:
        with suppress(MeshError):
            return self.search.recorded()
        return None

    def fingerprint(self) -> dict[str, str]:
        """Return the digest of the search."""
        return {"search": self.search.digest}

    def expected_size(self) -> ExpectedSize:
        """Return the size of the original, since nothing is known of the result, and the memory of a trial."""
        size = self.search.original.expected_size()
        return replace(size, projected_bytes=self.search.projected_bytes(size.triangles), is_known=False)
