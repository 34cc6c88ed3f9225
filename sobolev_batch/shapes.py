"""Shapes: surfaces in closed form and by a formula of your own, meshes of spheres, and similarities."""

from sobolev_batch.geometry.closed_forms import Ellipsoid, Sphere, Torus
from sobolev_batch.geometry.smooth import Interval, ParametrisedSurface
from sobolev_batch.geometry.subdivision import icosphere
from sobolev_batch.geometry.surface import Similarity

__all__ = ["Ellipsoid", "Interval", "ParametrisedSurface", "Similarity", "Sphere", "Torus", "icosphere"]
