"""`tree.sobolev`: norms, distances and spectra of any order from all that a store holds."""

from collections.abc import Iterator

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.causes import band_coordinates
from sobolev_batch.norms.columns import AREA, KERNEL, LENGTH, NUMBER, described, order_axis
from sobolev_batch.norms.estimate import AREA_AND_SHAPE
from sobolev_batch.parameters import as_names
from sobolev_batch.tables.evaluator import Evaluator
from sobolev_batch.tables.open import complete_meshes, finished_group, reference_of, similarity_of
from sobolev_batch.tables.other_orders import Meshes, require_fields, stored_evaluator, table_at
from sobolev_batch.tables.results import table_of
from sobolev_batch.transform.lattice import Orders, check_orders, smooth_step

# The upper end of a band, its squares (orders,), its energy, and the standard error of that.
Band = tuple[float, Reals, float, float]
_OF_DISTANCES = ("distance", "error", "error_part", "relative", "relative_error", *AREA_AND_SHAPE)
# The innermost octave has this many spacings of the lattice within it.
_FEWEST_SPACINGS = 4
# A band's window is one half at this fraction of its cutoff.
_HALF_WEIGHT = 0.75


@xr.register_datatree_accessor("sobolev")  # type: ignore[no-untyped-call]
class StoreAccessor:
    """Norms, distances and spectra of any order as methods of an open store: ``tree.sobolev.distance(-2)``.

    They use the octaves beside the fields, if the study has some; functions of fields do not.

    Raises:
        InputError: In all methods: the tree does not say where it was opened, or no mesh with a field has that label.
        OrderError: In all methods: an order is not below -1/2.
        DamageError: In all methods: stored values are not what was written.

    >>> import sobolev_batch as sb
    >>> tree = sb.open_store("storage/icosphere.zarr")
    >>> found = tree.sobolev.distance([-4, -3.5], "icosphere/1")
    >>> found["distance"].dims, bool((found["error"] < found["distance"]).all())
    (('order',), True)
    """

    def __init__(self, tree: xr.DataTree) -> None:
        self._tree = tree

    def norm(self, order: Orders, mesh: Meshes = None) -> xr.Dataset:
        """Return the norms of meshes with their errors, from stored spectra; see `sobolev_batch.norm`.

        Args:
            order: One order s < -1/2, or several.
            mesh: Label of a mesh, or several; default all.

        Returns:
            As `sobolev_batch.norm`, float64, in the square root of a unit length; for several meshes over `mesh`
            besides, with the coordinates of the store's tables, and NaN for meshes that failed.

        >>> import sobolev_batch as sb
        >>> tree = sb.open_store("storage/icosphere.zarr")
        >>> f"{tree.sobolev.norm(-4, 'reference')['norm'].item():.3f}"
        '3.511'
        >>> tree.sobolev.norm([-4, -3.5])["norm"].sizes
        Frozen({'mesh': 5, 'order': 2})
        """
        return self._chosen(table_at(self._tree, "norms", check_orders(order), mesh).drop_vars("beyond"), order, mesh)

    def distance(self, order: Orders, mesh: Meshes = None, other: str | None = None) -> xr.Dataset:
        """Return distances of meshes with their errors, relative to the other mesh, and in parts of area and shape.

        Those to the study's reference come from stored spectra: all meshes at a new order take a second or two.
        Those to another mesh are computed from stored fields. See `sobolev_batch.distance`.

        Args:
            order: One order s < -1/2, or several.
            mesh: Label of a mesh, or several; default all.
            other: Label of the mesh that they are compared with, which the area part is a multiple of; default the
                study's reference.

        Returns:
            `distance`, its `error` and as `error_part` the parts of that (`part`), `relative` and `relative_error` as
            `sobolev_batch.distance`, with `area_part` and `shape_part`, their `area_part_error` and `shape_part_error`,
            float64, in the square root of a unit length; for several meshes over `mesh` besides, see `norm`.

        >>> import sobolev_batch as sb
        >>> tree = sb.open_store("storage/icosphere.zarr")
        >>> found = tree.sobolev.distance(-4, "icosphere/1")
        >>> bool(abs(found["area_part"] ** 2 + found["shape_part"] ** 2 - found["distance"] ** 2) < 1e-12)
        True
        >>> tree.sobolev.distance(-2.5)["relative"].sizes
        Frozen({'mesh': 5})
        """
        if other is None or other == reference_of(self._tree):
            table = table_at(self._tree, "convergence", check_orders(order), mesh)
            return self._chosen(table[[name for name in _OF_DISTANCES if name in table]], order, mesh)
        meshes = finished_group(self._tree, "meshes")
        labels = complete_meshes(self._tree) if mesh is None else as_names(mesh)
        evaluator, rows = stored_evaluator(self._tree, order, *labels, other)
        found = evaluator.norms(rows[:-1])
        columns = {**found.distances.named("distance"), **found.reference.area_and_shape(found.distances)}
        columns |= found.distances.relative_to(found.reference.norms)
        table = table_of(columns, meshes.sel(mesh=labels), evaluator.orders)
        return self._chosen(table, order, mesh if isinstance(mesh, str) else labels)

    def _chosen(self, table: xr.Dataset, order: Orders, mesh: Meshes) -> xr.Dataset:
        """Return a table (mesh, order) of some meshes, without the dimension of what is single."""
        if mesh is not None:
            require_fields(self._tree, table, as_names(mesh))
            table = table.sel(mesh=mesh if isinstance(mesh, str) else list(mesh))
        if np.ndim(order) == 0:
            table = table.squeeze("order")
        return table.assign_attrs(kernel=KERNEL)

    def spectrum(self, order: Orders, mesh: str, other: str | None = None) -> xr.Dataset:
        """Return the squared distance of two meshes, or the squared norm of one, by octaves of the frequency |ξ|.

        Neighbouring bands overlap smoothly; at its two ends a band has half of its weight. Without octaves, the last
        band has all of its weight up to the end of the lattice.

        Args:
            order: One order s < -1/2, or several.
            mesh: Label of one mesh.
            other: Label of the other mesh; default none, for the norm.

        Returns:
            Dataset over `band`, float64, with the coordinates `lower` and `upper` in cycles per unit length,
            `longest_wavelength` and `shortest_wavelength` in units of length, and `own_longest_wavelength` and
            `own_shortest_wavelength` in the meshes' own unit; `squared` (order, band), in units of
            length, and its `share` of what has been measured, NaN between equal meshes; `energy` (band), the mean of
            ∫_{|ξ|=r} |a^ - b^|² dS, and its standard error `energy_error`, in squared units of length. The attribute
            `energy_limit` is twice the area of all surfaces, which the energy tends to if no parts of them coincide.

        >>> import sobolev_batch as sb
        >>> tree = sb.open_store("storage/icosphere.zarr")
        >>> bands = tree.sobolev.spectrum(-4, "icosphere/1", "reference")
        >>> round(bands["share"].sum().item(), 6)
        1.0
        """
        evaluator, indices = stored_evaluator(self._tree, order, *([mesh] if other is None else [mesh, other]))
        upper, squares, energies, deviations = map(np.array, zip(*_bands(evaluator, indices), strict=True))
        lower = np.array([0.0, *upper[:-1]])
        dims, values, _ = axis = order_axis(order)
        squared = squares.T.reshape(*values.shape, -1)
        areas = evaluator.areas[indices].sum()
        with np.errstate(invalid="ignore"):
            share = squared / squared.sum(axis=-1)[..., None]
        return xr.Dataset(
            {
                "squared": ((*dims, "band"), squared, described("squared value", LENGTH)),
                "share": ((*dims, "band"), share, described("share", NUMBER)),
                "energy": ("band", energies, described("energy on a sphere of frequencies", AREA)),
                "energy_error": ("band", deviations, described("standard error of the energy", AREA)),
            },
            coords={"order": axis, **band_coordinates(lower, upper, similarity_of(self._tree))},
            attrs={"kernel": KERNEL, "energy_limit": 2 * float(areas)},
        )


def _bands(evaluator: Evaluator, rows: list[int]) -> Iterator[Band]:
    """Yield the bands of a field or of the difference of two: those of the lattice, then the octaves."""
    lattice, sampling = evaluator.lattice, evaluator.sampling
    count = max(1, (lattice.M // (2 * _FEWEST_SPACINGS)).bit_length())
    cutoffs = lattice.xi_max / 2.0 ** np.arange(count)[::-1]
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    windows = np.diff([smooth_step(radii, cutoff) for cutoff in cutoffs], axis=0, prepend=0.0)
    sums, upper = evaluator.sums_over_shells(rows), _HALF_WEIGHT * cutoffs
    energies = windows @ sums / np.diff(upper, prepend=0.0)
    if sampling is None:
        # No octave takes over from the last band.
        windows[-1], upper[-1] = 1 - windows[:-1].sum(axis=0), lattice.xi_max
    squares = windows * sums @ (1 + radii[:, None] ** 2) ** evaluator.orders
    yield from ((*ends, 0.0) for ends in zip(upper.tolist(), squares, energies.tolist(), strict=True))
    if sampling is not None:
        values = [evaluator.read_octaves(row) for row in rows]
        of_octaves = evaluator.octave_sums(values[0] - values[1] if len(rows) > 1 else values[0])
        for own, one in zip(sampling.octaves, of_octaves, strict=True):
            yield _HALF_WEIGHT * own.octave.highest, one.squares, one.energy, one.energy_deviation
