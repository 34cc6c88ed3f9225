"""The sources `moved` and `noisy`: a mesh elsewhere, and a mesh with noise, by which distances can be measured."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Point
from sobolev_batch.surfaces.sources.derived.nested import NestedSource, load_mesh
from sobolev_batch.surfaces.sources.generated import Triple
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    ExpectedSize,
    Fingerprint,
    Member,
    at_most,
    single_member,
)

Reals = NDArray[np.float64]

# Raise it whenever a mesh is displaced in another way.
_VERSION = 1
# Measured peak of displacing a mesh, for each of its triangles.
_DISPLACING_BYTES = 400

# Lengths as fractions of the radius of the mesh's bounding sphere.
Fractions = Annotated[
    tuple[Annotated[float, Field(gt=0, allow_inf_nan=False, strict=False)], ...],
    Field(min_length=1, strict=False),
    at_most(MOST_ENTRIES),
]


class MovedSource(NestedSource):
    """A mesh moved by some distances.

    Attributes:
        mesh: Table of a source with one member, the mesh to move.
        distances: Distances, as fractions of the radius of the mesh's bounding sphere.
        direction: Direction to move in; its length does not matter.
    """

    distances: Fractions
    direction: Triple = (1.0, 0.0, 0.0)

    @field_validator("direction")
    @classmethod
    def _check_direction(cls, direction: Point) -> Point:
        if not any(direction):
            raise ValueError("must not be zero")
        return direction

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each distance, the smallest first."""
        original = single_member(self.mesh, folder)
        x, y, z = np.asarray(self.direction) / np.linalg.norm(self.direction)
        return tuple(
            MovedMember(f"{distance:g}", -1, original, distance, (float(x), float(y), float(z)))
            for distance in sorted(set(self.distances))
        )


class NoisySource(NestedSource):
    """A mesh whose vertices are displaced along its normals at random; see `with_noise`.

    Attributes:
        mesh: Table of a source with one member, the mesh to displace.
        amplitudes: Standard deviations of the noise, as fractions of the radius of the mesh's bounding sphere.
        seed: Seed of the noise, which is the same for all amplitudes but for their size.
    """

    amplitudes: Fractions
    seed: Annotated[int, Field(ge=0)] = 0

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each amplitude, the smallest first."""
        original = single_member(self.mesh, folder)
        return tuple(
            NoisyMember(f"{amplitude:g}", -1, original, amplitude, self.seed)
            for amplitude in sorted(set(self.amplitudes))
        )


@dataclass(frozen=True)
class _DisplacedMember(Member, ABC):
    """A mesh with other vertices.

    Attributes:
        original: Member of the mesh.
        amount: Size of the displacement, as a fraction of the radius of the mesh's bounding sphere.
    """

    original: Member
    amount: float
    kind: ClassVar[str]

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprint of the mesh, and all that its displacement follows from."""
        return {self.kind: dict(self.original.fingerprint()), "amount": self.amount, "version": _VERSION}

    def expected_size(self) -> ExpectedSize:
        """Return the size of the mesh, and the memory that it takes to make and to displace it."""
        size = self.original.expected_size()
        return ExpectedSize(size.triangles, max(size.projected_bytes, _DISPLACING_BYTES * size.triangles), size.seconds)


@dataclass(frozen=True)
class MovedMember(_DisplacedMember):
    """A mesh moved in a direction of length one."""

    direction: Point
    kind: ClassVar[str] = "moved"

    def load(self) -> Mesh:
        """Move the mesh."""
        mesh = load_mesh(self.original)
        _, radius = mesh.bounding_sphere
        return Mesh(mesh.vertices + self.amount * radius * np.asarray(self.direction), mesh.triangles)

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprint of the mesh, the distance and the direction."""
        return {**super().fingerprint(), "direction": list(self.direction)}


@dataclass(frozen=True)
class NoisyMember(_DisplacedMember):
    """A mesh with noise."""

    seed: int
    kind: ClassVar[str] = "noisy"

    def load(self) -> Mesh:
        """Displace the vertices."""
        mesh = load_mesh(self.original)
        _, radius = mesh.bounding_sphere
        return with_noise(mesh, self.amount * radius, self.seed)

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprint of the mesh, the amplitude and the seed."""
        return {**super().fingerprint(), "seed": self.seed}


def with_noise(mesh: Mesh, amplitude: float, seed: int) -> Mesh:
    """Return a mesh whose vertices are displaced along its normals by independent Gaussian numbers.

    Vertices at the same place are displaced together, so that no cracks open.

    Args:
        mesh: Mesh with m vertices.
        amplitude: Standard deviation of the displacements, in units of length.
        seed: Seed of the random numbers.
    """
    places, place_of_vertex = np.unique(mesh.vertices, axis=0, return_inverse=True)
    place_of_vertex = place_of_vertex.reshape(-1)
    normals = _normals(places, place_of_vertex[mesh.triangles])
    sizes = amplitude * np.random.default_rng(seed).standard_normal(len(places))
    return Mesh((places + sizes[:, None] * normals)[place_of_vertex], mesh.triangles)


def _normals(vertices: Reals, triangles: NDArray[np.int64]) -> Reals:
    """Return the mean normal of the triangles at each vertex, weighted by area, (m, 3); zero where they cancel."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    crosses = np.cross(b - a, c - a)
    sums = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(crosses[:, axis], 3), len(vertices)) for axis in range(3)], axis=1
    )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.asarray(np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0))
