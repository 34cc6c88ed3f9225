"""Errors to be expected of the rules of a mesh's triangles, and the loosest tolerance that keeps them small enough."""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np

from sobolev_batch.arrays import Reals
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.transform.backends import Backend, sums_at
from sobolev_batch.transform.coherence import RANGES, coherence, unpaired
from sobolev_batch.transform.faces import FaceArrays
from sobolev_batch.transform.lattice import FrequencyLattice
from sobolev_batch.transform.rules import FINEST_TOLERANCE, choose_rules, rule_ranges, typical_errors

# Parts of squared errors at some frequencies (n,): of even errors in phase, of odd ones in phase, and the rest.
_ErrorParts = tuple[Reals, Reals, Reals]
# Fraction of the odd errors that was seen to remain between neighbouring triangles.
_ODD_REMAINDER = 0.2
# Classes of triangles of similar size at most.
_BINS = 48
# Tolerances are tried in this many steps per decade, from the loosest one.
_LOOSEST_TOLERANCE, _STEPS_PER_DECADE = 0.1, 4
# The typical error of a frequency for a largest one, and the phases (radians) at which triangles may repeat.
_TYPICAL_OF_LARGEST, _RESONANCE = 0.3, 2.0


def loosest_tolerance(mesh: Mesh, lattice: FrequencyLattice, orders: Sequence[float], norms: Reals) -> float:
    """Return the largest tolerance of triangle rules whose error is predicted to have at most some norms (orders,).

    On fine meshes the prediction was measured to be one to ten times the true error, on coarse ones down to a fifth.
    """
    classes, shared, radii = size_classes(mesh, FaceArrays.of_mesh(mesh)), shares_vertices(mesh), _radii(lattice)
    mean = _mean_coherence(radii, classes)

    def suffices(tolerance: float) -> bool:
        even, _, rest = _error_parts(classes, lattice.highest_frequency, radii, tolerance, shared)
        return bool(np.all(np.sqrt(_radial_integrals(even * mean + rest, radii, orders)) <= norms))

    return _loosest(FINEST_TOLERANCE, suffices)


def tolerance_for(mesh: Mesh, highest_frequency: float, eps: float, faces: FaceArrays, backend: Backend) -> float:
    """Return the largest tolerance of triangle rules with a predicted error of eps · area at most up to a frequency.

    It is eps at least. The errors of triangles that are small beside the wavelength cancel, unless pieces of the mesh
    repeat. Of icospheres, scans and random triangles the largest error was measured to be at most 0.8 eps, of arrays of
    boxes, tetrahedra and spheres 0.6, and of two layers of opposite triangles 1.5.
    """
    classes, shared = size_classes(mesh, faces), shares_vertices(mesh)
    radii, alike = highest_frequency * (np.arange(RANGES) + 1) / RANGES, unpaired(faces) ** 2
    allowed = (_TYPICAL_OF_LARGEST * eps * float(classes[2].sum())) ** 2
    mean, none, whole = _mean_coherence(radii, classes), np.zeros(RANGES), np.ones(RANGES)

    @cache
    def parts(tolerance: float) -> _ErrorParts:
        return _error_parts(classes, highest_frequency, radii, tolerance, shared, _RESONANCE)

    def suffices(tolerance: float, found: Reals) -> bool:
        even, odd, rest = parts(tolerance)
        return bool((even * np.maximum(found, mean) + odd * np.maximum(found, alike) + rest).max() <= allowed)

    tolerance = _loosest(eps, partial(suffices, found=none))
    # Most coarse meshes keep eps even if all errors were in phase.
    if tolerance == eps or suffices(tolerance, whole):
        return tolerance
    return _loosest(eps, partial(suffices, found=coherence(mesh, highest_frequency, faces, backend)))


def _loosest(finest: float, suffices: Callable[[float], bool]) -> float:
    """Return the largest tolerance that suffices, in steps from the finest one, which is taken where none does."""
    decades = max(0.0, math.log10(_LOOSEST_TOLERANCE / finest))
    tolerances = (finest * 10 ** np.linspace(decades, 0, round(decades * _STEPS_PER_DECADE) + 1)).tolist()
    return float(tolerances[bisect_left(tolerances[:-1], True, key=suffices)])


def size_classes(mesh: Mesh, faces: FaceArrays) -> Reals:
    """Return the triangles of a mesh in classes of similar size, (4, classes).

    The rows are the least and greatest centroid radius of each class, and its sums of areas and of squared areas.
    """
    largest = float(mesh.centroid_radii.max())
    smallest = max(float(mesh.centroid_radii.min()), 1e-6 * largest)
    count = max(1, min(_BINS, math.ceil(8 * math.log(largest / smallest))))
    edges = np.geomspace(smallest, largest, count + 1)
    classes = np.searchsorted(np.asarray(edges[1:-1], like=faces.radii), faces.radii)
    values = faces.areas, faces.areas * faces.areas
    sums = (faces.backend.download(sums_at(classes, each, count)) for each in values)
    return np.stack([edges[:-1], edges[1:], *sums])


def _mean_coherence(radii: Reals, classes: Reals) -> Reals:
    """Return the mean energy of a surface's transform on |ξ| = r over area² (n,): 1 near zero, and 1 / (2π r² area)."""
    return np.asarray(np.minimum(1.0, 1 / (2 * np.pi * radii**2 * classes[2].sum())))


def _error_parts(
    classes: Reals, highest_frequency: float, radii: Reals, tolerance: float, shared: bool, resonance: float = math.inf
) -> _ErrorParts:
    """Predict parts of the squared error of a mesh's points at frequencies |ξ| (n,), from its `size_classes`.

    They are those of the even and of the odd errors of triangles, if all were in phase, and that of errors which add up
    like random numbers, or in any case. The even errors add up like the surface's transform itself; the odd ones like
    random numbers, but for those without an opposite one. Triangles that are larger than a phase may repeat with the
    wavelength: there both add up.
    """
    smallest, largest, areas, squares = classes
    rules, ranges = rule_ranges(tolerance, shared)
    # The rule for the smallest of a class, applied to the largest of it: never less than the truth.
    splits, choice = choose_rules(2 * np.pi * highest_frequency * smallest, ranges)
    phases = 2 * np.pi * radii[:, None] * (largest / 2.0**splits)
    even, odd = np.empty_like(phases), np.empty_like(phases)
    for rule in np.unique(choice):
        members = choice == rule
        even[:, members], odd[:, members] = typical_errors(rules[rule], phases[:, members])
    repeats = phases > resonance
    rest = (np.where(repeats, even + odd, 0) @ areas) ** 2
    rest += (even**2 + (_ODD_REMAINDER * odd) ** 2) @ (squares / 4.0**splits)
    return (np.where(repeats, 0, even) @ areas) ** 2, (odd @ areas) ** 2, rest


def _radii(lattice: FrequencyLattice) -> Reals:
    low, high = lattice.radial_range
    return np.asarray(low + (np.arange(RANGES) + 0.5) / RANGES * (high - low))


def weight_masses(lattice: FrequencyLattice, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+|ξ|²)^s over the range of a lattice (orders,)."""
    return _radial_integrals(np.ones(RANGES), _radii(lattice), orders)


def _radial_integrals(energy: Reals, radii: Reals, orders: Sequence[float]) -> Reals:
    """Return ∫ (1+r²)^s energy(r) 4πr² dr by the midpoint rule (orders,)."""
    step = radii[1] - radii[0]
    return np.array([np.sum((1 + radii**2) ** order * energy * 4 * np.pi * radii**2) * step for order in orders])


def shares_vertices(mesh: Mesh) -> bool:
    """Tell whether triangles share vertices, as those of a surface do, and not each have their own as in a soup."""
    return len(mesh.used_vertices) <= len(mesh.triangles)
