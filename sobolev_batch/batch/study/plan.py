"""A plan: a study's surfaces as rows of the store, with what each costs and what identifies it."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from sobolev_batch.batch.study.lattice_choice import LatticeChoice, basis_of, choose
from sobolev_batch.batch.study.study import REFERENCE_LABEL, FamilyReference, Study
from sobolev_batch.errors import InputError, MeshError, StudyError
from sobolev_batch.spectral.adaptive.solve import DistanceTarget
from sobolev_batch.spectral.errors.samples import Sample, draws_for
from sobolev_batch.spectral.fields import USUAL_DEGREE
from sobolev_batch.spectral.lattice import Block, Lattice
from sobolev_batch.spectral.transform.settings import TransformSettings
from sobolev_batch.spectral.transform.transform import NUMERICS_VERSION, require_inside
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.sphere import Sphere
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.names import quoted
from sobolev_batch.surfaces.sources.registry import Member, single_member

_log = logging.getLogger(__name__)

# A chunk of the store holds one field, or one block of it above this size.
_LARGEST_CHUNK_BYTES = 256 << 20


@dataclass(frozen=True)
class Row:
    """One surface of a study.

    Attributes:
        label: family/name, or "reference"; unique in the study.
        family: name of the family, or "reference".
        member: the surface to be made.
        fingerprint: of the member, see `Member.fingerprint_digest`; empty where that cannot be told because a
            file of it cannot be read.
        key: SHA-256 of all that its field depends on; empty likewise.
    """

    label: str
    family: str
    member: Member
    fingerprint: str
    key: str


@dataclass(frozen=True)
class Plan:
    """What a run of a study would do.

    Attributes:
        study: the study.
        similarity: its one similarity transform.
        rows: every surface, the reference among them, in the order of the study.
        reference: the label of the reference's row.
        blocks: the blocks of the lattice, one chunk of the store each.
        choice: the lattice and precision of all fields.
        sample: of the reference, where an accuracy is asked for.
    """

    study: Study
    similarity: Similarity
    rows: tuple[Row, ...]
    reference: str
    blocks: tuple[Block, ...]
    choice: LatticeChoice
    sample: Sample | None = None

    @property
    def lattice(self) -> Lattice:
        """The lattice of all fields."""
        return self.choice.lattice

    @property
    def transform(self) -> TransformSettings:
        """How fields are computed; where an accuracy is asked for, eps and tolerance follow for each."""
        given = self.study.transform
        return given if self.study.accuracy is None else TransformSettings(None, self.choice.dtype, given.quadrature)

    def aim(self, row: Row) -> DistanceTarget | None:
        """What the field of a row is computed for, where an accuracy is asked for."""
        if self.study.accuracy is None:
            return None
        sample, closest = (None, self.choice.closest) if row.label == self.reference else (self.sample, ())
        return DistanceTarget(self.study.orders, self.study.accuracy, sample, closest)

    def on(self, choice: LatticeChoice) -> Plan:
        """The same study with its fields on another lattice."""
        rows = tuple(replace(row, key=_key(self.study, self.similarity, choice, row.fingerprint)) for row in self.rows)
        return replace(self, rows=rows, choice=choice, blocks=_blocks(choice))

    @cached_property
    def item_bytes(self) -> int:
        """Bytes of one sample of a field."""
        return 16 if self.choice.dtype == "complex128" else 8

    @property
    def field_bytes(self) -> int:
        """Bytes of one stored field."""
        return self.lattice.half.size * self.item_bytes


def make_plan(study: Study, known: LatticeChoice | None = None) -> Plan:
    """Resolve a study: list its surfaces, choose its similarity and lattice, identify every field.

    The reference is loaded, since the similarity depends on it, and a few pilots where an accuracy is
    asked for; no other surface is.

    Args:
        study: what to compute.
        known: an earlier choice for it, which is kept as long as it was made from the same.

    Raises:
        StudyError: labels that collide, or sources that make no surface.
        MeshError: the reference cannot be read.
        LatticeError: the reference does not fit into the lattice's period.
        AccuracyError: the accuracy is out of reach within the memory.
    """
    members = members_of(study)
    reference = _reference_label(study, members)
    surface = _load_reference(members[reference][1])
    similarity = Similarity.to_unit_ball(surface) if study.scaling.mode == "reference" else study.scaling.fixed
    scaled = similarity.apply(surface)
    choice = _choice(study, similarity, members, reference, scaled, known)
    if not isinstance(scaled, Sphere):
        require_inside(scaled, choice.lattice)
    if study.proximity is not None and not isinstance(scaled, Mesh):
        raise StudyError(
            "proximity: Hausdorff and Chamfer distances are measured between meshes, and the reference is not one "
            f"but a {type(scaled).__name__}; take a fine mesh of it for the reference, or leave [proximity] out"
        )
    rows = []
    for label, (family, member) in members.items():
        fingerprint = _fingerprint(label, member)
        rows.append(Row(label, family, member, fingerprint, _key(study, similarity, choice, fingerprint)))
    sample = None
    if study.accuracy is not None:
        draws = draws_for([scaled], choice.lattice, study.orders, USUAL_DEGREE)
        sample = Sample.of(scaled, draws)
    return Plan(study, similarity, tuple(rows), reference, _blocks(choice), choice, sample)


def _choice(
    study: Study,
    similarity: Similarity,
    members: Mapping[str, tuple[str, Member]],
    reference: str,
    surface: Surface,
    known: LatticeChoice | None,
) -> LatticeChoice:
    if study.lattice is not None:
        return LatticeChoice(study.lattice, study.transform.dtype)
    basis = basis_of(study, similarity, members[reference][1].fingerprint())
    if known is not None and known.basis == basis:
        return known
    others = {label: member for label, member in members.items() if label != reference}
    return choose(study, similarity, surface, others, basis)


def _blocks(choice: LatticeChoice) -> tuple[Block, ...]:
    item_bytes = 16 if choice.dtype == "complex128" else 8
    return choice.lattice.split(_LARGEST_CHUNK_BYTES // item_bytes)


def members_of(study: Study) -> dict[str, tuple[str, Member]]:
    """Family and member of each surface of a study, by label; none is made.

    Raises:
        StudyError: labels that collide, or sources that make no surface.
    """
    members: dict[str, tuple[str, Member]] = {}
    for family in study.families:
        try:
            found = family.source.members(study.folder)
        except StudyError as error:
            raise StudyError(f"family {family.name!r}: {error}") from error
        for member in found:
            label = f"{family.name}/{member.name}"
            if label in members:
                raise StudyError(f"two surfaces of the study have the label {label!r}")
            members[label] = family.name, member
    if not isinstance(study.reference, FamilyReference):
        try:
            members[REFERENCE_LABEL] = REFERENCE_LABEL, single_member(study.reference, study.folder)
        except StudyError as error:
            raise StudyError(f"reference: {error}") from error
    return members


def _reference_label(study: Study, members: Mapping[str, tuple[str, Member]]) -> str:
    if not isinstance(study.reference, FamilyReference):
        return REFERENCE_LABEL
    family = [member for name, member in members.values() if name == study.reference.family]
    if study.reference.member is None:
        finest = max(family, key=lambda member: member.level)
        if sum(member.level == finest.level for member in family) > 1:
            raise StudyError(
                f"reference: the family {study.reference.family!r} has no finest level; name one of its members: "
                + ", ".join(member.name for member in family[:5])
            )
        return f"{study.reference.family}/{finest.name}"
    label = f"{study.reference.family}/{study.reference.member}"
    if label not in members:
        raise StudyError(
            f"reference: the family {study.reference.family!r} has no member {quoted(study.reference.member)}"
        )
    return label


def _load_reference(member: Member) -> Surface:
    try:
        return member.load()
    except InputError as error:
        raise MeshError(f"the reference cannot be made: {error}") from error


def _fingerprint(label: str, member: Member) -> str:
    try:
        return member.fingerprint_digest()
    except InputError as error:
        _log.warning("%s: %s", label, error)
        return ""


def _key(study: Study, similarity: Similarity, choice: LatticeChoice, fingerprint: str) -> str:
    if not fingerprint:
        return ""
    parts = {
        "surface": fingerprint,
        "similarity": [similarity.scale, *similarity.origin],
        "lattice": [choice.lattice.xi_max, choice.lattice.M],
        "transform": [study.transform.eps, choice.dtype, study.transform.quadrature.method],
        "numerics": NUMERICS_VERSION,
        # What is asked of a field follows from its distance to the reference.
        "accuracy": choice.basis,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
