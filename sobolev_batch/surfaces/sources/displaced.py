"""Meshes with vertices elsewhere: `moved` and `noisy` ones, by which distances are measured, and those of a `flow`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Point
from sobolev_batch.surfaces.sources.generated import Triple
from sobolev_batch.surfaces.sources.registry import (
    MOST_ENTRIES,
    Fingerprint,
    MadeMember,
    Member,
    NestedSource,
    Times,
    at_most,
    load_mesh,
    single_member,
)

Reals = NDArray[np.float64]

# Raise it whenever a mesh is displaced or carried in another way.
_VERSION = 1
# Measured peaks of displacing a mesh and of carrying it along, for each of its triangles.
_DISPLACING_BYTES, _CARRYING_BYTES = 400, 200

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
        direction = (np.asarray(self.direction) / np.linalg.norm(self.direction)).tolist()
        return tuple(
            _displaced("moved", original, distance, _moved, direction, {"direction": direction})
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
            _displaced("noisy", original, amplitude, _noisy, self.seed, {"seed": self.seed})
            for amplitude in sorted(set(self.amplitudes))
        )


class FlowSource(NestedSource):
    """A mesh at several times, with its vertices carried along by a flow on the spheres around the origin.

    The flow winds the sphere up while it turns, and back: after one period each vertex is where it began. It is the
    fourth case of Nair and Lauritzen: the second with a background rotation, without divergence. Vertices follow it
    exactly; triangles stay flat.

    Source: R. Nair, P. Lauritzen, "A class of deformational flow test cases for linear transport problems on the
    sphere" (2010), doi:10.1016/j.jcp.2010.08.014.

    Attributes:
        mesh: Table of a source with one member, the mesh at time 0.
        times: Times, in the unit of the period.
        period: Time after which all is as it was.
        strength: Strength k of the deformation, in radians per unit of time.
    """

    times: Times
    period: Annotated[float, Field(gt=0, allow_inf_nan=False, strict=False)] = 5.0
    strength: Annotated[float, Field(allow_inf_nan=False, strict=False)] = 2.0

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each time, in their order."""
        start = single_member(self.mesh, folder)
        return tuple(
            MadeMember(
                repr(time),
                -1,
                _carried_mesh,
                {"time": time, "settings": [self.period, self.strength], "version": _VERSION},
                (time, self.period, self.strength),
                originals={"flow": start},
                triangle_bytes=_CARRYING_BYTES,
                time=time,
            )
            for time in sorted(self.times)
        )


def _displaced(
    kind: str, original: Member, amount: float, displace: Callable[..., Mesh], argument: Any, what: Fingerprint
) -> Member:
    """Return the member of a mesh displaced by a fraction of the radius of its bounding sphere."""
    return MadeMember(
        f"{amount:g}",
        -1,
        displace,
        {"amount": amount, "version": _VERSION, **what},
        (amount, argument),
        originals={kind: original},
        triangle_bytes=_DISPLACING_BYTES,
    )


def _moved(original: Member, amount: float, direction: Point) -> Mesh:
    mesh = load_mesh(original)
    _, radius = mesh.bounding_sphere
    return Mesh(mesh.vertices + amount * radius * np.asarray(direction), mesh.triangles)


def _noisy(original: Member, amount: float, seed: int) -> Mesh:
    mesh = load_mesh(original)
    _, radius = mesh.bounding_sphere
    return with_noise(mesh, amount * radius, seed)


def _carried_mesh(start: Member, time: float, period: float, strength: float) -> Mesh:
    mesh = load_mesh(start)
    return Mesh(carried(np.asarray(mesh.vertices), time, period, strength), mesh.triangles)


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


def carried(points: Reals, time: float, period: float, strength: float) -> Reals:
    """Return where the flow of `FlowSource` carries points from time 0 on, (n, 3).

    Args:
        points: Points at time 0, (n, 3).
        time: Time at which they are requested.
        period: Period T.
        strength: Strength k, in radians per unit of time.

    On the unit sphere, in a frame that turns once around z in a period T, the velocity at x is
    2k cos(πt/T) y (x × e_y), where y is the point's own coordinate. It keeps y, so each circle around the y axis turns
    as a whole, by the angle -(2kT/π) sin(πt/T) y.
    """
    x, y, z = points.T
    radii = np.linalg.norm(points, axis=1)
    heights = np.divide(y, radii, out=np.zeros_like(y), where=radii > 0)
    angles = -2 * strength * period / np.pi * np.sin(np.pi * time / period) * heights
    cosines, sines = np.cos(angles), np.sin(angles)
    wound = np.stack([cosines * x + sines * z, y, cosines * z - sines * x])
    turn = 2 * np.pi * time / period
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((rotation @ wound).T)
