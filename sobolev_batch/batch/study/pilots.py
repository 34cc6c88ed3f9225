"""Pilots: the few surfaces of a study from which its lattice is chosen."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

from sobolev_batch.errors import InputError
from sobolev_batch.surfaces.shapes.similarity import Similarity
from sobolev_batch.surfaces.shapes.surface import Extent, Surface
from sobolev_batch.surfaces.sources.registry import Member

# Family and member of each surface, by label.
Members = Mapping[str, tuple[str, Member]]

# Pilots are the coarsest and the finest member of this many families.
_MOST_FAMILIES = 6
# A surface that reaches so many times as far as the reference is in another unit, or another object.
_FARTHEST = 8.0
# Memory that a pilot may take to be made, and that all surfaces together may take whose extents are looked at.
_MOST_BYTES = 1e9


@dataclass(frozen=True, eq=False)
class Pilots:
    """Pilots of a study, and the extent of all its surfaces as far as it is quickly known.

    Attributes:
        surfaces: Pilots in the study's unit, by label.
        extent: Extent of the reference and of all surfaces that were looked at.
        set_aside: Reason for each surface that cannot be read or reaches much too far, by label.
    """

    surfaces: Mapping[str, Surface]
    extent: Extent
    set_aside: Mapping[str, str]

    @classmethod
    def from_members(cls, members: Members, similarity: Similarity, reference: Surface) -> Self:
        """Make the pilots of a study, and look at other surfaces that are quickly loaded.

        Args:
            members: Members of the study without the reference.
            similarity: Similarity transform of the study.
            reference: Reference in the study's unit.
        """
        survey = Survey(members, similarity, reference.extent)
        surfaces = survey.ends_of_families()
        survey.look_at_others(surfaces)
        return cls(surfaces, Extent.union([reference.extent, *survey.extents.values()]), survey.set_aside)


class Survey:
    """Surfaces that are loaded one after the other, of which the extents stay.

    Attributes:
        extents: Extent of each surface that was loaded, by label.
        set_aside: Reason for each surface that cannot be read or reaches much too far, by label.
    """

    def __init__(self, members: Members, similarity: Similarity, reference: Extent) -> None:
        self.members = members
        self.similarity = similarity
        self.reach = reference.reach
        self.extents: dict[str, Extent] = {}
        self.set_aside: dict[str, str] = {}

    def ends_of_families(self) -> dict[str, Surface]:
        """Return the coarsest and the finest surface of each of a few families."""
        surfaces: dict[str, Surface] = {}
        for labels in self._families()[:_MOST_FAMILIES]:
            for candidates in (labels, labels[::-1]):
                surfaces |= self._first(candidates, surfaces)
        return surfaces

    def look_at_others(self, known: Container[str] = ()) -> None:
        """Note the extents of other surfaces that are quickly loaded, as long as they take little memory together."""
        left = _MOST_BYTES
        for label, (_, member) in self.members.items():
            if label in known or not member.is_quickly_loaded:
                continue
            left -= member.expected_size().projected_bytes
            if left < 0:
                return
            self._looked_at(label)

    def _families(self) -> list[list[str]]:
        """Return the labels of each family, from coarse to fine as far as that is known."""
        families: dict[str, list[str]] = {}
        for label, (family, _) in self.members.items():
            families.setdefault(family, []).append(label)
        return [sorted(labels, key=self._fineness) for labels in families.values()]

    def _fineness(self, label: str) -> tuple[int, int]:
        _, member = self.members[label]
        return member.level, 0 if member.level >= 0 else member.expected_size().triangles

    def _first(self, labels: Sequence[str], known: Mapping[str, Surface]) -> dict[str, Surface]:
        """Return the first of some surfaces that can be a pilot; those before it are set aside."""
        for label in labels:
            if self.members[label][1].expected_size().projected_bytes > _MOST_BYTES:
                continue
            surface = known[label] if label in known else self._looked_at(label)
            if surface is not None:
                return {label: surface}
        return {}

    def _looked_at(self, label: str) -> Surface | None:
        """Return a surface whose extent is noted, or None if it is set aside."""
        if label in self.set_aside:
            return None
        try:
            surface = self.similarity.apply(self.members[label][1].load())
        except InputError as error:
            self.set_aside[label] = str(error)
            return None
        times = surface.extent.reach / self.reach
        if times > _FARTHEST:
            self.set_aside[label] = f"it reaches {times:.3g} times as far as the reference; are both in the same unit?"
            return None
        self.extents[label] = surface.extent
        return surface
