"""The rigid motion that brings a mesh nearest to another one: low frequencies from many starts, then higher ones."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from sobolev_batch.arrays import Complexes, Reals
from sobolev_batch.extras.fitting.adjoint import MeshTransform
from sobolev_batch.extras.fitting.derivatives import factors_of
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh, each
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.fourier import TransformSettings
from sobolev_batch.transform.lattice import Lattice, SobolevWeights, single_order
from sobolev_batch.transform.nufft import WeightedPoints, transform_points
from sobolev_batch.transform.nufft_costs import NufftSpec

# Stages: highest frequency on each axis, in cycles per radius, most points of each mesh, motions that go on to the next
# stage, and steps.
_STAGES = ((0.6, 1000, 12, 12), (1.4, 4000, 2, 12), (4.0, 10**9, 1, 25))
# The spacing is in cycles per radius: it lets surfaces lie over twice the radius from the center.
_SPACING, _EPS = 0.2, 1e-6
# A mesh whose center is farther from the other one, in radii, begins there: a period away nothing would draw it in.
_IN_PLACE = 1.0
# A motion that leaves more than this of the squared distance is none: of a mesh with symmetries, many are as good.
_NO_GAIN = 0.98
# Steps shorter than this, in radii, end a stage; a step is damped by at most this much.
_SHORTEST, _MOST_DAMPED = 1e-7, 1e6


def align(a: MeshLike, b: MeshLike, *, order: float = -2.0) -> Reals:
    """Return the rigid motion of a mesh that makes its Sobolev distance from another one as small as it was found.

    It is none where no motion found lowers the distance by a hundredth. The search starts from the mesh as it is,
    unless that is elsewhere, and around the center of b from 24 rotations by right angles, and from those that match
    principal axes. It compares long wavelengths first. A mesh with symmetries has several best motions. Reflections and
    changes of size are no rigid motions.

    Args:
        a: Mesh to move, or what `as_mesh` makes one of.
        b: Mesh to bring it to, likewise. Both show the same object: of parts, no motion is best.
        order: Order s < -1/2 of the norm, in radii of the bounding sphere of b.

    Returns:
        Matrix (4, 4) in the unit of length of the meshes: x becomes ``matrix[:3, :3] @ x + matrix[:3, 3]``.

    Raises:
        OrderError: The order is not below -1/2.
        InputError: See `as_mesh`.

    >>> import numpy as np
    >>> import sobolev_batch as sb
    >>> egg = sb.shapes.Ellipsoid((1.0, 0.7, 0.5)).mesh(2)
    >>> matrix = sb.fitting.align(sb.Mesh(egg.vertices + [0.2, 0.1, 0.0], egg.triangles), egg)
    >>> np.abs(matrix[:3, 3] + [0.2, 0.1, 0.0]).max() < 1e-5
    np.True_
    """
    order, meshes = single_order(order), each(as_mesh, {"a": a, "b": b})
    radius = meshes[1].bounding_sphere[1]
    centers = [mesh.areas @ np.sum(mesh.corners(), axis=0) / (3 * mesh.area) for mesh in meshes]
    # Around their centers of area, in radii of the second.
    pairs = zip(meshes, centers, strict=True)
    own, target = (Mesh((mesh.vertices - center) / radius, mesh.triangles) for mesh, center in pairs)
    as_is = (centers[0] - centers[1]) / radius
    starts = [(np.eye(3), as_is)] if np.linalg.norm(as_is) <= _IN_PLACE else []
    starts += [(turn, np.zeros(3)) for turn in (*Rotation.create_group("O").as_matrix(), *_of_axes(own, target))]
    scored = [(0.0, *start) for start in starts]
    for xi_max, points, kept, steps in _STAGES:
        lattice = Lattice(xi_max, 2 * round(xi_max / _SPACING))
        stage = _Stage(lattice, order, _nodes(own, lattice, points), _nodes(target, lattice, points))
        scored = sorted((stage.lowered(turn, shift, steps) for _, turn, shift in scored), key=lambda found: found[0])
        scored = scored[:kept]
    square, turn, shift = scored[0]
    matrix = np.eye(4)
    if starts[0][1] is not as_is or square < _NO_GAIN * stage.expansion(*starts[0])[0]:
        matrix[:3, :3], matrix[:3, 3] = turn, centers[1] + radius * shift - turn @ centers[0]
    return matrix


class _Stage:
    """The squared distance of two sets of points on a lattice, as a function of a rigid motion of the first one."""

    def __init__(self, lattice: Lattice, order: float, own: WeightedPoints, target: WeightedPoints) -> None:
        self.lattice, self.own = lattice, own
        self.spec = NufftSpec(lattice.shape, _EPS)
        self.roots = np.sqrt(factors_of(SobolevWeights(lattice, (order,)))[0])
        self.target = self._transform(target)
        self.frequencies = np.meshgrid(*lattice.axes, indexing="ij")

    def lowered(self, turn: Reals, shift: Reals, steps: int) -> tuple[float, Reals, Reals]:
        """Return the squared distance, rotation and shift after steps of Levenberg and Marquardt."""
        damping = 1e-3
        square, gradient, curvature = self.expansion(turn, shift)
        for _ in range(steps):
            step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature) + 1e-30), -gradient)
            # A step in the rotation is a small one after it.
            trial = Rotation.from_rotvec(step[:3]).as_matrix() @ turn, shift + step[3:]
            found = self.expansion(*trial)
            if found[0] < square:
                (turn, shift), (square, gradient, curvature) = trial, found
                damping /= 5
            else:
                damping *= 5
            if np.abs(step).max() < _SHORTEST or damping > _MOST_DAMPED:
                break
        return square, turn, shift

    def expansion(self, turn: Reals, shift: Reals) -> tuple[float, Reals, Reals]:
        """Return the squared distance, half its gradient (6,) and the matrix (6, 6) of Gauss and Newton."""
        turned = turn @ self.own.coordinates
        places, weights = turned + shift[:, None], self.own.weights
        values = self._transform(WeightedPoints(places, weights))
        # The moments with each coordinate give the derivatives of a rotation.
        x, y, z = (self._transform(WeightedPoints(places, weights * row)) for row in turned)
        u, v, w = self.frequencies
        slopes = np.stack([v * -z + w * y, w * -x + u * z, u * -y + v * x, *(xi * values for xi in (u, v, w))])
        slopes = (-2j * np.pi * self.roots * slopes).reshape(6, -1)
        rest = (self.roots * (values - self.target)).ravel()
        return float(np.vdot(rest, rest).real), (slopes.conj() @ rest).real, (slopes.conj() @ slopes.T).real

    def _transform(self, points: WeightedPoints) -> Complexes:
        return np.asarray(transform_points([points], self.lattice, self.lattice.half, self.spec)[0])


def _nodes(mesh: Mesh, lattice: Lattice, most: int) -> WeightedPoints:
    """Return quadrature nodes of a mesh for a lattice; of more than some, random ones as a rough likeness."""
    nodes = MeshTransform.from_mesh(mesh, lattice, TransformSettings(_EPS, tolerance=1e-4)).nodes(mesh.vertices)
    if len(nodes.weights) <= most:
        return nodes
    total = nodes.weights.sum()
    drawn = np.random.default_rng(0).choice(len(nodes.weights), most, p=nodes.weights / total)
    return WeightedPoints(np.ascontiguousarray(nodes.coordinates[:, drawn]), np.full(most, total / most))


def _of_axes(own: Mesh, target: Mesh) -> list[Reals]:
    """Return the four rotations that take the principal axes of a mesh to those of another."""
    pairs = [(mesh.areas, np.sum(mesh.corners(), axis=0) / 3) for mesh in (own, target)]
    first, second = (np.linalg.eigh((areas * centers.T) @ centers)[1] for areas, centers in pairs)
    turns = [second @ np.diag(signs) @ first.T for signs in product((1.0, -1.0), repeat=3)]
    return [turn for turn in turns if np.linalg.det(turn) > 0]
