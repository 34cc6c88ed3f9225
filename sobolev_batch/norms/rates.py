"""Observed orders of convergence: how fast a sequence of meshes comes nearer to a surface."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence, Set

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import InputError
from sobolev_batch.geometry.formats.conversion import MeshLike, SurfaceLike, as_mesh, each
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.columns import describe
from sobolev_batch.norms.distances import distance
from sobolev_batch.norms.fields import as_operand
from sobolev_batch.parameters import callback
from sobolev_batch.transform.lattice import Lattice, Orders

# A rate is formed between meshes whose sizes differ by this factor at least: between nearly equal ones chance decides.
_LEAST_RATIO = 1.1


def convergence(
    meshes: Sequence[MeshLike] | Mapping[str, MeshLike],
    reference: SurfaceLike,
    order: Orders = DEFAULT_ORDER,
    *,
    rtol: float | None = None,
    lattice: Lattice | None = None,
    best_effort: bool = False,
    seed: int = 0,
    on_progress: Callable[[int, int], object] | None = None,
) -> xr.Dataset:
    """Return the distances of some meshes to a surface, and the observed orders of convergence between them.

    Args:
        meshes: Meshes in any form that `as_mesh` takes, in any order, with labels if they are a mapping.
        reference: Surface that they approximate: a mesh, or one by formula such as `shapes.Sphere`. Orders weigh
            wavelengths above one unit alike: of one many units large, scale all by `shapes.Similarity.to_unit_ball`.
        order: One order s < -1/2, or several.
        rtol: Largest error of each distance relative to it; see `distance`.
        lattice: Lattice to compute on, in place of an rtol.
        best_effort: Return the nearest that can be reached where the rtol is out of reach, instead of raising.
        seed: Seed of the random frequencies, see `distance`.
        on_progress: Called with the number of meshes that are done, and that of all.

    Returns:
        Dataset over `mesh` and `order` with the variables of `distance`, and with `rate` and `rate_error`: the power p
        in distance ~ h^p between a mesh and the next one whose mean edge length h is larger by a tenth at least. They
        are NaN for the coarsest meshes, and for distances below their error. Coordinates (mesh) are the labels,
        `edge_length` (mean) and `triangles`. All are float64, but for booleans and counts.

    Raises:
        InputError: There are no meshes, or neither an rtol nor a lattice; see also `distance`.

    `sobolev_batch.plot.convergence` draws it.

    >>> from sobolev_batch import convergence
    >>> from sobolev_batch.shapes import Sphere, icosphere
    >>> found = convergence({f"level {k}": icosphere(k) for k in (1, 2, 3)}, Sphere(), -4.0, rtol=1e-2)
    >>> found["rate"].round(1).values.tolist()
    [nan, 2.0, 2.0]
    >>> found["triangles"].sel(mesh="level 3").item()
    1280
    """
    if isinstance(meshes, str | bytes | Set) or not isinstance(meshes, Iterable):
        raise InputError(f"meshes are a list, or meshes by name, found {type(meshes).__name__}; put it into a list")
    named = meshes if isinstance(meshes, Mapping) else {str(number): mesh for number, mesh in enumerate(meshes)}
    if not named:
        raise InputError("there are no meshes; pass one or more")
    notify, found = callback(on_progress), []
    converted = dict(zip(named, each(as_mesh, {f"mesh {label!r}": mesh for label, mesh in named.items()}), strict=True))
    (reference,) = each(as_operand, {"reference": reference})
    for done, (label, mesh) in enumerate(converted.items(), start=1):
        try:
            one = distance(mesh, reference, order, rtol=rtol, lattice=lattice, best_effort=best_effort, seed=seed)
        except InputError as error:
            error.add_note(f"This is mesh {label!r}, number {done} of {len(named)}.")
            raise
        found.append(one)
        notify(done, len(named))
    table = xr.concat(found, "mesh", combine_attrs="drop_conflicts").assign_coords(
        mesh=("mesh", np.array(list(converted), dtype=object)),
        edge_length=("mesh", [mesh.edge_length_range[0] for mesh in converted.values()]),
        triangles=("mesh", [len(mesh.triangles) for mesh in converted.values()]),
    )
    rates, errors = xr.apply_ufunc(
        observed_rates,
        *(table["distance"], table["error"], table["edge_length"]),
        input_core_dims=[["mesh"]] * 3,
        output_core_dims=[["mesh"]] * 2,
        vectorize=True,
        keep_attrs=False,
    )
    return describe(table.assign(rate=rates.transpose("mesh", ...), rate_error=errors.transpose("mesh", ...)))


def observed_rates(distances: Reals, errors: Reals, sizes: Reals) -> tuple[Reals, Reals]:
    """Return the observed order p in distance ~ size^p between each mesh and a coarser one, with its error.

    The coarser one is the next whose size is larger by a tenth at least. From distances, their errors and mean edge
    lengths (n,) follow log(d_coarse/d)/log(h_coarse/h) and its error, (n,) each: NaN for the coarsest meshes, for
    meshes without a distance or size, and for distances below their error.

    >>> sizes = np.array([0.4, 0.2, 0.1])
    >>> observed_rates(3 * sizes**2, np.zeros(3), sizes)[0].round(6)
    array([nan,  2.,  2.])
    """
    rates, uncertainties = np.full(len(distances), np.nan), np.full(len(distances), np.nan)
    usable = np.flatnonzero(np.isfinite(sizes) & (sizes > 0) & (distances > 0) & (errors < distances))
    by_size = usable[np.argsort(-sizes[usable], kind="stable")]
    coarser_counts = np.searchsorted(-sizes[by_size], -_LEAST_RATIO * sizes[by_size], side="right")
    fine, coarse = by_size[coarser_counts > 0], by_size[coarser_counts[coarser_counts > 0] - 1]
    span = np.log(sizes[coarse] / sizes[fine])
    rates[fine] = np.log(distances[coarse] / distances[fine]) / span
    # The widest that both distances allow.
    uncertainties[fine] = sum(-np.log1p(-errors[i] / distances[i]) for i in (coarse, fine)) / span
    return rates, uncertainties
