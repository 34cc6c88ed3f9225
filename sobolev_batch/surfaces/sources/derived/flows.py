"""The source `flow`: a mesh that a flow on the sphere carries along, at several times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.derived.nested import NestedSource, load_mesh
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Fingerprint, Member, Times, single_member

Reals = NDArray[np.float64]

# Raise it whenever a mesh moves to another place.
_VERSION = 1
# Measured peak of moving a mesh, for each of its triangles.
_MOVING_BYTES = 200


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
            CarriedMember(repr(time), -1, start, self.period, self.strength, time=time) for time in sorted(self.times)
        )


@dataclass(frozen=True)
class CarriedMember(Member):
    """A mesh that a flow has carried along since time 0.

    Attributes:
        start: Member of the mesh at time 0.
        period: Period of the flow.
        strength: Strength of the deformation.
    """

    start: Member
    period: float
    strength: float

    def load(self) -> Surface:
        """Move the vertices of the mesh."""
        mesh = load_mesh(self.start)
        return Mesh(carried(np.asarray(mesh.vertices), self.time or 0.0, self.period, self.strength), mesh.triangles)

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprint of the mesh at time 0, the time and the flow."""
        return {
            "flow": dict(self.start.fingerprint()),
            "time": self.time,
            "settings": [self.period, self.strength],
            "version": _VERSION,
        }

    def expected_size(self) -> ExpectedSize:
        """Return the size of the mesh, and the memory that it takes to make and to move it."""
        size = self.start.expected_size()
        return ExpectedSize(size.triangles, max(size.projected_bytes, _MOVING_BYTES * size.triangles), size.seconds)


def carried(points: Reals, time: float, period: float, strength: float) -> Reals:
    """Return where the flow of `FlowSource` carries points from time 0 on, (n, 3).

    Args:
        points: Points at time 0, (n, 3).
        time: Time at which they are asked for.
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
