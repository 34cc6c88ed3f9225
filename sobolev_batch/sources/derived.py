"""Families of one other mesh: coarser, or carried along by a flow; docs/studies.md has their keys."""

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from sobolev_batch.errors import MeshError, from_extra
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.sources.generated import Length, Levels, Number
from sobolev_batch.sources.registry import MadeMember, Member, NestedSource, OtherSource, Several, Times, single_member

# Measured peak of simplifying and of clustering, for each triangle of the original.
_REDUCING_BYTES = 450
# No mesh that can be read has as many.
_MOST_TRIANGLES = 10**9
# Even cells need several input vertices for each output vertex; pyacvd advises to subdivide until there are.
_VERTICES_PER_CLUSTER = 10

# Raise it whenever a mesh is carried in another way.
_VERSION = 1
# Measured peak of carrying a mesh along, for each of its triangles.
_CARRYING_BYTES = 200


def decimated(mesh: Mesh, triangles: int, keep_boundary: bool = False) -> Mesh:
    """Return a mesh with its edges collapsed down to a number of triangles, but for those at an open border if kept."""
    with from_extra("studies", "decimation needs", MeshError):
        import fast_simplification

    arrays = np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)
    return Mesh(*fast_simplification.simplify(*arrays, target_count=triangles, preserve_border=keep_boundary))


def remeshed(mesh: Mesh, triangles: int) -> Mesh:
    """Return a mesh of about a number of triangles, around clusters of the vertices of another one."""
    with from_extra("studies", "remeshing needs", MeshError):
        import pyacvd
        import pyvista
    # A closed surface of genus g has V = F/2 + 2 - 2g: two vertices more than half the triangles.
    clusters = triangles // 2 + 2
    with warnings.catch_warnings():
        # pyacvd 0.4 still reads an attribute that pyvista has renamed.
        warnings.filterwarnings("ignore", message=".*_connectivity_array")
        clustering = pyacvd.Clustering(pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.triangles))
        while len(clustering.mesh.points) < _VERTICES_PER_CLUSTER * clusters:
            clustering.subdivide(2)
        clustering.cluster(clusters)
        result = clustering.create_mesh()
    return Mesh(np.asarray(result.points), np.asarray(result.regular_faces))


class _ReducingSource(NestedSource):
    """Meshes of one mesh, down to numbers of triangles, by a library.

    The libraries have thresholds that are lengths, so what they make depends on the unit. With a ``radius``, meshes are
    scaled for them until their bounding sphere has this one.
    """

    triangles: Several[Annotated[int, Field(ge=4, le=_MOST_TRIANGLES)]]
    radius: Length | None = None

    kind: ClassVar[str]
    library: ClassVar[str]
    # What the library does to a mesh, down to a number of triangles.
    reduce: ClassVar[Callable[..., Mesh]]
    # Measured, for each triangle that it leaves.
    triangle_seconds: ClassVar[float] = 0.0

    @property
    def options(self) -> dict[str, Any]:
        """Further arguments of `reduce`, which the fingerprint has too."""
        return {}

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per triangle count, coarse to fine."""
        originals, libraries = {self.kind: single_member(self.mesh, folder)}, (self.library,)
        made = partial(MadeMember, originals=originals, libraries=libraries, triangle_bytes=_REDUCING_BYTES)
        made = partial(made, triangle_seconds=self.triangle_seconds)
        reduce = partial(type(self).reduce, **self.options)
        about = {**self.options, **({} if self.radius is None else {"radius": self.radius})}
        return tuple(
            made(str(n), rank, _reduced, {"triangles": n, **about}, (reduce, n, self.radius), triangles=n)
            for rank, n in enumerate(sorted(set(self.triangles)))
        )


class DecimateSource(_ReducingSource):
    """Simplifications of one mesh by quadric edge collapse, which keep the vertices of open borders if asked to.

    M. Garland, P. S. Heckbert, "Surface simplification using quadric error metrics" (1997),
    doi:10.1145/258734.258849; by the library fast-simplification.
    """

    keep_boundary: bool = False

    kind, library = "decimate", "fast-simplification"
    reduce: ClassVar[Callable[..., Mesh]] = staticmethod(decimated)

    @property
    def options(self) -> dict[str, Any]:
        """The choice of borders, where it is not that of the library."""
        return {"keep_boundary": True} if self.keep_boundary else {}


def _reduced(mesh: Mesh, reduce: Callable[[Mesh, int], Mesh], triangles: int, radius: float | None) -> Mesh:
    if triangles >= (count := len(mesh.triangles)):
        raise MeshError(f"the mesh has {count} triangles and cannot be reduced to {triangles}: choose fewer")
    if radius is None:
        return reduce(mesh, triangles)
    center, own = mesh.bounding_sphere
    found = reduce(Mesh((mesh.vertices - center) * (radius / own), mesh.triangles), triangles)
    return Mesh(found.vertices * (own / radius) + center, found.triangles)


class RemeshSource(_ReducingSource):
    """Even remeshings of one mesh, by clustering its vertices into cells of similar area.

    A closed mesh comes out within a few triangles of the counts. S. Valette, J.-M. Chassery, "Approximated
    centroidal Voronoi diagrams for uniform polygonal mesh coarsening" (2004),
    doi:10.1111/j.1467-8659.2004.00769.x; by the library pyacvd, which the extra ``studies`` installs.
    """

    kind, library, triangle_seconds = "remesh", "pyacvd", 5.5e-4
    reduce: ClassVar[Callable[..., Mesh]] = staticmethod(remeshed)

    @property
    def libraries(self) -> tuple[str, ...]:
        """The clustering library, and the distributions that the other source needs."""
        return "pyacvd", *super().libraries


class SphericalLevelsSource(NestedSource):
    """Coarse versions of a surface whose vertices follow an icosahedral refinement.

    Its vertices (as of FreeSurfer's fsaverage) are in order of levels: the first 10*4^N + 2 form level N. Its map to
    the sphere has the same vertices in this order, and the convex hull of the first ones has the triangles of a level.
    """

    sphere: OtherSource
    levels: Levels

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per level, coarse to fine."""
        surface, sphere = single_member(self.mesh, folder), single_member(self.sphere, folder)
        # The hull takes memory like a reduction of the surface.
        made = partial(MadeMember, originals={"surface": surface, "sphere": sphere}, triangle_bytes=_REDUCING_BYTES)
        return tuple(
            made(str(level), level, _first_vertices, {"spherical level": level}, (level,), triangles=20 * 4**level)
            for level in sorted(set(self.levels))
        )


def _first_vertices(surface: Mesh, sphere: Mesh, level: int) -> Mesh:
    """Take the vertices of a level from a surface, and its triangles from the hull of its map to the sphere."""
    count = 10 * 4**level + 2
    if len(surface.vertices) != len(sphere.vertices) or count > len(surface.vertices):
        needed = f"the first {count} vertices of a surface and of its map to the sphere"
        raise MeshError(f"level {level} needs {needed}, found {len(surface.vertices)} and {len(sphere.vertices)}")
    from scipy.spatial import ConvexHull

    hull = ConvexHull(sphere.vertices[:count] - sphere.vertices[:count].mean(axis=0))
    if (found := len(hull.simplices)) != (expected := 2 * count - 4):
        first = f"the first {count} vertices of the map to the sphere"
        raise MeshError(f"{first} are not in convex position: their hull has {found} triangles, expected {expected}")
    return Mesh(surface.vertices[:count], hull.simplices.astype(np.int64))


class FlowSource(NestedSource):
    """A mesh at several times, with its vertices carried along by a flow on the spheres around the origin.

    The flow winds the sphere up while it turns, and back: after one period each vertex is where it began. It is the
    fourth case of Nair and Lauritzen: the second with a background rotation, without divergence. Vertices follow it
    exactly; triangles stay flat.

    Source: R. Nair, P. Lauritzen, "A class of deformational flow test cases for linear transport problems on the
    sphere" (2010), doi:10.1016/j.jcp.2010.08.014.
    """

    times: Times
    period: Length = 5.0
    strength: Number = 2.0

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each time, in their order."""
        made = partial(MadeMember, originals={"flow": single_member(self.mesh, folder)}, triangle_bytes=_CARRYING_BYTES)
        settings = [self.period, self.strength]
        about = {"settings": settings, "version": _VERSION}
        return tuple(
            made(repr(time), -1, carried, {"time": time, **about}, (time, *settings), time=time)
            for time in sorted(self.times)
        )


def carried(mesh: Mesh, time: float, period: float, strength: float) -> Mesh:
    """Return a mesh whose vertices the flow of `FlowSource` has carried along from time 0 on.

    On the unit sphere, in a frame that turns once around z in a period T, the velocity at x is
    2k cos(πt/T) y (x × e_y), where y is the point's own coordinate and k the strength, in radians per unit of time.
    It keeps y, so each circle around the y axis turns as a whole, by the angle -(2kT/π) sin(πt/T) y.
    """
    x, y, z = mesh.vertices.T
    radii = np.linalg.norm(mesh.vertices, axis=1)
    heights = np.divide(y, radii, out=np.zeros_like(y), where=radii > 0)
    angles = -2 * strength * period / np.pi * np.sin(np.pi * time / period) * heights
    cosines, sines = np.cos(angles), np.sin(angles)
    wound = np.stack([cosines * x + sines * z, y, cosines * z - sines * x])
    turn = 2 * np.pi * time / period
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    return Mesh((rotation @ wound).T, mesh.triangles)
