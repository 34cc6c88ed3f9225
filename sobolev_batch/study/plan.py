"""A plan: the surfaces of a study as rows of the store, with a digest of all that each field depends on."""

import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from sobolev_batch.errors import MeshError, StudyError, one_line
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Extent, Similarity, Surface
from sobolev_batch.norms.accuracy.solve import DistanceTarget
from sobolev_batch.norms.fields import USUAL_DEGREE
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.sampling import TailSampling
from sobolev_batch.sources.names import quoted
from sobolev_batch.sources.registry import Member, digest_of
from sobolev_batch.study.lattice_choice import LatticeChoice
from sobolev_batch.study.pilots import Look, choose_lattice
from sobolev_batch.study.schema import REFERENCE_LABEL, FamilyReference
from sobolev_batch.study.study import Study, StudyObject
from sobolev_batch.transform.fourier import NUMERICS_VERSION, TransformSettings, require_inside
from sobolev_batch.transform.lattice import Block, Lattice
from sobolev_batch.transform.probe import Sample, draws_for

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """One surface of a study, as what a row of its store is to hold.

    Attributes:
        label: Family/name, or "reference"; unique in the study.
        fingerprint: Digest of the member, see `Member.fingerprint_digest`; empty if one of its files cannot be read.
        key: SHA-256 of all that its field depends on; empty if the fingerprint is.
        is_chosen: True if a run computes it; see `Study.only`.
    """

    label: str
    family: str
    member: Member
    fingerprint: str
    key: str = ""
    is_chosen: bool = True


@dataclass(frozen=True)
class Plan:
    """Plan of a study of one object: its surfaces in their order, the reference's label, the lattice of all fields.

    Area and extent of the reference are in the study's unit of length. It has a sample if an accuracy is requested. The
    look is what was seen of the surfaces that the choice of the lattice made.
    """

    study: Study
    similarity: Similarity
    rows: tuple[Row, ...]
    reference: str
    choice: LatticeChoice
    reference_area: float
    reference_extent: Extent
    sample: Sample | None = None
    look: Look = field(default_factory=Look)

    @property
    def name(self) -> str:
        """Name in the store: that of the study, and of its object where it has one."""
        return f"{self.study.name} {self.study.object.name}".rstrip()

    @property
    def lattice(self) -> Lattice:
        """Lattice of all fields."""
        return self.choice.lattice

    @property
    def transform(self) -> TransformSettings:
        """Settings of the transforms. If an accuracy is requested, eps and tolerance are chosen for each field."""
        given, choice = self.study.transform, self.choice
        if self.study.accuracy is None:
            return given
        return TransformSettings(None, choice.transform_dtype, given.quadrature, stored=choice.dtype)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the lattice, one chunk of the store each."""
        return self.lattice.half.split(self.study.largest_chunk_bytes // self.item_bytes)

    @property
    def item_bytes(self) -> int:
        """Bytes of one sample of a field."""
        return np.dtype(self.choice.dtype).itemsize

    @property
    def tail(self) -> TailSampling | None:
        """Sampling of the octaves beyond the lattice, if there are any."""
        return self.choice.tail

    @property
    def field_bytes(self) -> int:
        """Bytes of one stored field, octaves included."""
        return (self.lattice.half.size + (0 if self.tail is None else self.tail.size)) * self.item_bytes

    def distance_target(self, row: Row) -> DistanceTarget | None:
        """Return the accuracy that the field of a row is computed for, if an accuracy is requested."""
        if self.study.accuracy is None:
            return None
        sample, closest = (None, self.choice.closest) if row.label == self.reference else (self.sample, ())
        return DistanceTarget(self.study.orders, self.study.accuracy, sample, closest)

    def with_choice(self, choice: LatticeChoice, also: Collection[str] = ()) -> Self:
        """Return the plan of the same study on another lattice, where a run computes some more labels."""
        keyed = ((row, _key(self.study, self.similarity, choice, row.fingerprint)) for row in self.rows)
        rows = (replace(row, key=key, is_chosen=row.is_chosen or row.label in also) for row, key in keyed)
        return replace(self, rows=tuple(rows), choice=choice)

    def without_surfaces(self) -> Self:
        """Return what the tasks of all surfaces need of the plan: they take it along, each a surface of its own."""
        return replace(self, study=replace(self.study, objects={}, table={}, cache=None), rows=(), look=Look())


def make_plan(study: Study, earlier_choice: LatticeChoice | None = None) -> Plan:
    """Plan a study of one object: list its surfaces, choose its similarity and lattice, identify every field.

    Only the reference is loaded, and a few pilots for an accuracy. MeshError where the reference cannot be read,
    LatticeError where it does not fit into the period; see also `StudyObject.members` and `choose_lattice`.
    """
    members, reference = study.object.members, _reference_label(study.object)
    try:
        own = members[reference][1].load()
    except Exception as error:  # its source may raise anything
        raise MeshError(f"the reference cannot be made: {one_line(error)}") from error
    similarity = study.object.scaling or Similarity.to_unit_ball(own)
    surface = similarity.apply(own)
    choice, look = _lattice_choice(study, similarity, reference, surface, earlier_choice)
    look.take_notes(reference, surface)
    require_inside(surface, choice.lattice)
    if study.proximity is not None and not isinstance(surface, Mesh):
        raise StudyError(
            "proximity: Hausdorff and Chamfer distances are measured between meshes, and the reference is not one "
            f"but a {type(surface).__name__}; take a fine mesh of it for the reference, or leave [proximity] out"
        )
    chosen = {reference, *(study.object.chosen(study.only) if study.only else members)}
    rows = (
        Row(label, family, member, fingerprint_of(label, member), is_chosen=label in chosen)
        for label, (family, member) in members.items()
    )
    sample = None
    if study.accuracy is not None:
        sample = Sample.from_surface(surface, draws_for([surface], choice.lattice, study.orders, USUAL_DEGREE))
    plan = Plan(study, similarity, tuple(rows), reference, choice, surface.area, surface.extent, sample, look)
    return plan.with_choice(choice)


def _lattice_choice(
    study: Study, similarity: Similarity, reference: str, surface: Surface, earlier: LatticeChoice | None
) -> tuple[LatticeChoice, Look]:
    own = study.object.members[reference][1]
    if study.lattice is not None:
        dtype = study.transform.dtype
        tail = TailSampling.usual(study.lattice.xi_max, study.octaves, [surface]) if study.octaves else None
        compared_with = fingerprint_of(reference, own) if tail or FaceNormals.from_surfaces([surface]) else ""
        return LatticeChoice(study.lattice, dtype, dtype, tail=tail, compared_with=compared_with), Look()
    if (accuracy := study.accuracy) is None:
        raise ValueError("a study has a lattice or an accuracy")
    # What the choice is made from, except families, which may gain meshes.
    made_from = {
        "accuracy": [accuracy.rtol, float(accuracy.allowed_bytes), accuracy.best_effort],
        "orders": study.orders,
        "dtype": study.dtype,
        "similarity": [similarity.scale, *similarity.origin],
        "reference": dict(own.fingerprint()),
    }
    basis = digest_of(made_from)
    if earlier is not None and earlier.basis == basis:
        return earlier, Look()
    others = {label: member for label, member in study.object.members.items() if label != reference}
    choice, look = choose_lattice(study, accuracy, similarity, surface, others)
    return replace(choice, basis=basis), look


def _reference_label(one: StudyObject) -> str:
    if not isinstance(one.reference, FamilyReference):
        return REFERENCE_LABEL
    family, name = one.reference.family, one.reference.member
    if name is None:
        candidates = [member for family_name, member in one.members.values() if family_name == family]
        finest = max(candidates, key=lambda member: member.level)
        if sum(member.level == finest.level for member in candidates) > 1:
            raise StudyError(
                f"reference: the family {family!r} has no finest level; name one of its members: "
                + ", ".join(member.name for member in candidates[:5])
            )
        name = finest.name
    if f"{family}/{name}" not in one.members:
        raise StudyError(f"reference: the family {family!r} has no member {quoted(name)}")
    return f"{family}/{name}"


def fingerprint_of(label: str, member: Member) -> str:
    """Return the digest of a member, see `Member.fingerprint_digest`; empty where a file of it cannot be read."""
    try:
        return member.fingerprint_digest()
    except Exception as error:  # its source may raise anything, and the task reports it
        _log.warning("%s: %s", label, one_line(error))
        return ""


def _key(study: Study, similarity: Similarity, choice: LatticeChoice, fingerprint: str) -> str:
    if not fingerprint:
        return ""
    dependencies: dict[str, Any] = {
        "surface": fingerprint,
        "similarity": [similarity.scale, *similarity.origin],
        "lattice": [choice.lattice.xi_max, choice.lattice.M],
        "transform": [study.transform.eps, choice.transform_dtype, choice.dtype, study.transform.quadrature],
        "numerics": NUMERICS_VERSION,
        # The target of a field follows from its distance to the reference.
        "accuracy": choice.basis,
    }
    if choice.tail is not None:
        dependencies["octaves"] = choice.tail.digest
    if choice.compared_with:
        dependencies["compared with"] = choice.compared_with
    return digest_of(dependencies)
