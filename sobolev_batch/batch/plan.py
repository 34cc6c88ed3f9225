"""A plan: a study's surfaces as rows of the store, with what each costs and what identifies it."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sobolev_batch.batch.study import REFERENCE_LABEL, FamilyReference, Study
from sobolev_batch.errors import InputError, MeshError, StudyError
from sobolev_batch.spectral.lattice import Block
from sobolev_batch.spectral.transform import NUMERICS_VERSION, memory_bytes, require_inside
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.similarity import Similarity
from sobolev_batch.surfaces.sources import Member, sole_member

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
        key: SHA-256 of all that its field depends on; empty where that cannot be told because a
            file of it cannot be read.
    """

    label: str
    family: str
    member: Member
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
    """

    study: Study
    similarity: Similarity
    rows: tuple[Row, ...]
    reference: str
    blocks: tuple[Block, ...]

    @cached_property
    def item_bytes(self) -> int:
        """Bytes of one sample of a field."""
        return 16 if self.study.transform.precision == "complex128" else 8

    @property
    def field_bytes(self) -> int:
        """Bytes of one stored field."""
        return self.study.lattice.half.size * self.item_bytes

    @property
    def task_memory_bytes(self) -> int:
        """Peak memory of one task, without its mesh."""
        return memory_bytes(self.blocks[0], self.study.transform)


def make_plan(study: Study) -> Plan:
    """Resolve a study: list its surfaces, choose its similarity, identify every field.

    The reference is loaded, since the similarity depends on it; no other surface is.

    Raises:
        StudyError: labels that collide, or sources that make no surface.
        MeshError: the reference cannot be read.
        LatticeError: the reference does not fit into the lattice's period.
    """
    members = _members(study)
    reference = _reference_label(study, members)
    similarity = _similarity(study, members[reference][1])
    rows = tuple(
        Row(label, family, member, _key(study, similarity, member, label))
        for label, (family, member) in members.items()
    )
    item_bytes = 16 if study.transform.precision == "complex128" else 8
    return Plan(study, similarity, rows, reference, study.lattice.split(_LARGEST_CHUNK_BYTES // item_bytes))


def _members(study: Study) -> dict[str, tuple[str, Member]]:
    members: dict[str, tuple[str, Member]] = {}
    for family in study.families:
        for member in family.source.members(study.folder):
            label = f"{family.name}/{member.name}"
            if label in members:
                raise StudyError(f"two surfaces of the study have the label {label!r}")
            members[label] = family.name, member
    if not isinstance(study.reference, FamilyReference):
        members[REFERENCE_LABEL] = REFERENCE_LABEL, sole_member(study.reference, study.folder)
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
        raise StudyError(f"reference: the family {study.reference.family!r} has no member {study.reference.member!r}")
    return label


def _similarity(study: Study, member: Member) -> Similarity:
    try:
        surface = member.load()
    except InputError as error:
        raise MeshError(f"the reference cannot be made: {error}") from error
    by_reference = study.scaling.mode == "reference"
    similarity = Similarity.to_unit_ball(surface) if by_reference else study.scaling.fixed
    scaled = similarity.apply(surface)
    if isinstance(scaled, Mesh):
        require_inside(scaled, study.lattice)
    return similarity


def _key(study: Study, similarity: Similarity, member: Member, label: str) -> str:
    try:
        fingerprint: Mapping[str, Any] = member.fingerprint()
    except InputError as error:
        _log.warning("%s: %s", label, error)
        return ""
    parts = {
        "surface": fingerprint,
        "similarity": [similarity.scale, *similarity.origin],
        "lattice": [study.lattice.xi_max, study.lattice.M],
        "transform": [study.transform.eps, study.transform.precision, study.transform.quadrature.method],
        "numerics": NUMERICS_VERSION,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
