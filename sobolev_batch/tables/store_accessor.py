"""`tree.sobolev`: norms, distances and spectra of any order from all that a store holds; its tables at any order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from sobolev_batch.arrays import Reals
from sobolev_batch.errors import DamageError, InputError
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.causes import band_coordinates
from sobolev_batch.norms.columns import AREA, KERNEL, LENGTH, NUMBER, describe, described, order_axis
from sobolev_batch.norms.estimate import AREA_AND_SHAPE, NormEstimate
from sobolev_batch.norms.fields import Quality
from sobolev_batch.sources.names import quoted
from sobolev_batch.store.layout import QUALITY
from sobolev_batch.store.records import Record, Records
from sobolev_batch.store.workspace import complete_records, rows_unlike_tables
from sobolev_batch.tables.open import (
    finished_group,
    reference_of,
    require_unchanged,
    similarity_of,
    source_of,
    store_of,
)
from sobolev_batch.tables.pairs import known_distances, pair_distances
from sobolev_batch.tables.reducer import Reducer
from sobolev_batch.tables.results import Results, table_of
from sobolev_batch.tables.shells import lower_bounds, spectrum_keys, stale_chunks
from sobolev_batch.transform.lattice import Orders, check_orders, shell_sums, single_order, smooth_step

# The upper end of a band, its squares (orders,), its energy, and the standard error of that.
Band = tuple[float, Reals, float, float]
# Labels of meshes: one, several, or all.
Meshes = str | Sequence[str] | None
_OF_DISTANCES = ("distance", "error", "error_part", "relative", "relative_error", *AREA_AND_SHAPE)
# Meshes whose distances from another are computed at a time, until others are certainly farther.
_CANDIDATES = 32
# The innermost octave has this many spacings of the lattice within it.
_FEWEST_SPACINGS = 4
# A band's window is one half at this fraction of its cutoff.
_HALF_WEIGHT = 0.75


@xr.register_datatree_accessor("sobolev")  # type: ignore[no-untyped-call]
class StoreAccessor:
    """Norms, distances and spectra of any order as methods of an open store: ``tree.sobolev.distance(-2)``.

    They use the octaves beside the fields, if the study has some. `field.sobolev` and the functions that take single
    fields know the lattice alone.

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
        return self._chosen(norms_at(self._tree, order, mesh).drop_vars("beyond"), order, mesh)

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
            table = convergence_at(self._tree, order, mesh)
            return self._chosen(table[[name for name in _OF_DISTANCES if name in table]], order, mesh)
        meshes = finished_group(self._tree, "meshes")
        complete = meshes["mesh"].values[meshes["status"].values == "complete"].tolist()
        labels = [mesh] if isinstance(mesh, str) else complete if mesh is None else list(mesh)
        reducer, rows = stored_reducer(self._tree, order, *labels, other)
        found = reducer.norms(rows[:-1])
        columns = {**found.distances.named("distance"), **found.reference.area_and_shape(found.distances)}
        columns["relative"], columns["relative_error"] = found.distances.relative_to(found.reference.norms)
        table = table_of(columns, meshes.sel(mesh=labels), reducer.orders)
        return self._chosen(table, order, mesh if isinstance(mesh, str) else labels)

    def nearest(self, mesh: str, count: int = 10, order: float = DEFAULT_ORDER) -> xr.Dataset:
        """Return the meshes nearest to one, nearest first, with their distances.

        Spectra bound each distance from below, so that only the fields of near meshes are read.

        Args:
            mesh: Label of a mesh.
            count: Number of meshes; fewer where the store has fewer others.
            order: Order s < -1/2.

        Returns:
            Dataset over `mesh` with `distance`, its `error`, and as `error_part` the parts of that (`part`).

        Raises:
            InputError: The count is not positive; see `StoreAccessor` for others.

        >>> import sobolev_batch as sb
        >>> tree = sb.open_store("storage/icosphere.zarr")
        >>> tree.sobolev.nearest("icosphere/1", 2, order=-4)["mesh"].values.tolist()
        ['icosphere/2', 'icosphere/3']
        """
        if count < 1:
            raise InputError(f"the number of nearest meshes must be positive, found {count!r}")
        orders, meshes = (single_order(order),), finished_group(self._tree, "meshes")
        reducer, _ = stored_reducer(self._tree, orders)
        labels = dict(zip(meshes["row"].values.tolist(), meshes["mesh"].values.tolist(), strict=True))
        _require_fields(self._tree, meshes, [mesh])
        row = int(meshes["row"].sel(mesh=mesh).item())
        bounds = lower_bounds(reducer, row, {one for one in reducer.complete if one in labels and one != row})
        candidates = sorted(bounds, key=bounds.__getitem__)
        # Values and the parts of their errors, and their rows, nearest first.
        found, rows = np.empty((5, 0)), np.empty(0, dtype=np.int64)
        for start in range(0, len(candidates), _CANDIDATES):
            if len(rows) >= count and found[0, -1] <= bounds[candidates[start]]:
                break
            group = candidates[start : start + _CANDIDATES]
            found = np.hstack([found, np.stack([*pair_distances(reducer, [row], group)])[:, 0, 0]])
            rows = np.append(rows, group)
            nearest = np.lexsort((rows, found[0]))[:count]
            found, rows = found[:, nearest], rows[nearest]
        estimate = NormEstimate(*found[:, None])
        table = table_of(estimate.named("distance"), meshes.sel(mesh=[labels[one] for one in rows.tolist()]), orders)
        return table.sel(order=orders[0])

    def _chosen(self, table: xr.Dataset, order: Orders, mesh: Meshes) -> xr.Dataset:
        """Return a table (mesh, order) of some meshes, without the dimension of what is single."""
        if mesh is not None:
            _require_fields(self._tree, table, [mesh] if isinstance(mesh, str) else list(mesh))
            table = table.sel(mesh=mesh if isinstance(mesh, str) else list(mesh))
        if np.ndim(order) == 0:
            table = table.squeeze("order")
        return table.assign_attrs(kernel=KERNEL)

    def spectrum(self, order: Orders, mesh: str, other: str | None = None) -> xr.Dataset:
        """Return the squared distance of two meshes, or the squared norm of one, by octaves of the frequency |ξ|.

        Neighbouring bands overlap smoothly; at its two ends a band has half of its weight.

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
        reducer, indices = stored_reducer(self._tree, order, *([mesh] if other is None else [mesh, other]))
        bands = [*_inner_bands(reducer, indices), *_octaves(reducer, indices)]
        upper, squares, energies, deviations = (np.array(column) for column in zip(*bands, strict=True))
        upper *= _HALF_WEIGHT
        lower = np.array([0.0, *upper[:-1]])
        dims, values, _ = axis = order_axis(order)
        squared = squares.T.reshape(*values.shape, -1)
        areas = reducer.areas[indices].sum()
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


def stored_reducer(tree: xr.DataTree, order: Orders, *meshes: str) -> tuple[Reducer, list[int]]:
    """Return the reducer of an open store for any orders, and the rows of some meshes.

    No record of other meshes is read, and distances are to the last one. Without labels, all records are read, and
    distances are to the reference. InputError where no mesh with a field has a label, DamageError where the record of a
    mesh is not the one that the tables were made from.
    """
    store, orders = store_of(tree), check_orders(order)
    labels, removed, chosen = store.labels(), store.removed, set(meshes)
    complete: dict[int, Record] = {}
    for first, part in store.parts:
        own = labels[first : first + part.row_count]
        known = ((i, label) for i, label in enumerate(own) if label and label not in removed)
        wanted = {i for i, label in known if not chosen or label in chosen}
        read = {i: Records(part).read_one(i) for i in wanted} if meshes else dict(enumerate(Records(part).read()))
        records = [read[i] if i in wanted else None for i in range(len(own))]
        for i, problem in (rows_unlike_tables(part, records) if wanted else {}).items():
            if i in wanted:
                raise part.damage(f"the field of {own[i]}", problem, i)
        complete |= {first + row: record for row, record in complete_records(records).items()}
    places = {label: row for row, label in enumerate(labels)}
    for mesh in meshes:
        if places.get(mesh) not in complete:
            raise _no_field(tree, mesh, labels[:3])
    rows, reference = [places[mesh] for mesh in meshes], places[store.attributes()["study"]["reference"]]
    qualities = {row: Quality.from_json(record.quality) for row, record in complete.items()}
    checksums = {row: record.checksums for row, record in complete.items()}
    compared_with = rows[-1] if rows else None
    return Reducer.for_fields(store, store.choice(), orders, qualities, checksums, reference, compared_with), rows


def _computed(tree: xr.DataTree, orders: tuple[float, ...], meshes: Meshes = None) -> Results:
    """Return norms, and distances to the reference, of meshes at orders that an open store lacks, from spectra."""
    store, reference = store_of(tree), reference_of(tree)
    table = finished_group(tree, "meshes", load=False)
    if meshes is not None:
        chosen = [meshes] if isinstance(meshes, str) else list(meshes)
        _require_fields(tree, table, chosen)
        table = table.sel(mesh=list(dict.fromkeys([*chosen, reference])))
    complete = table.isel(mesh=table["status"].values == "complete")
    labels, complete_rows, own_keys = (complete[name].values.tolist() for name in ("mesh", "row", "key"))
    row_of_reference = dict(zip(labels, complete_rows, strict=True)).get(reference, -1)
    keys = spectrum_keys(dict(zip(complete_rows, own_keys, strict=True)), row_of_reference)
    qualities: dict[int, Quality] = {}
    for first, part in store.parts:
        rows = [row for row in sorted(keys) if first <= row < first + part.row_count]
        if stale_chunks(part, {row - first: keys[row] for row in rows}):
            problem = "they are not those of the stored fields"
            raise DamageError(f"{part.path}: radial spectra are damaged ({problem}); run the study again", problem)
        texts = np.asarray(part.read(QUALITY, [row - first for row in rows])).tolist() if rows else []
        qualities |= {row: Quality.from_json(text) for row, text in zip(rows, texts, strict=True)}
    reducer = Reducer.for_fields(store, store.choice(), orders, qualities, {}, row_of_reference)
    return Results.from_spectra(reducer, table, reference)


def convergence_at(tree: xr.DataTree, order: Orders | None, meshes: Meshes = None) -> xr.Dataset:
    """Return the convergence table of an open store at some orders, of the store or not, in memory.

    The attribute ``computed`` lists the orders that were computed from radial spectra. The table may have more meshes
    than those that are needed. DamageError where a field is not what was stored.
    """
    stored = finished_group(tree, "convergence", load=False)
    accuracy = Accuracy(stored.attrs["rtol"]) if "rtol" in stored.attrs else None
    return _at_orders(
        tree, stored, order, lambda others: _computed(tree, others, meshes).convergence_table(accuracy)
    ).load()


def distances_at(tree: xr.DataTree, order: Orders | None) -> xr.Dataset:
    """Return the distances of a store's meshes, in the order of tables; lazily if it has all orders."""
    meshes = finished_group(tree, "meshes", load=False)
    labels = meshes["mesh"].values
    stored = finished_group(tree, "distances", load=False).drop_vars("key", errors="ignore").sel(mesh=labels)
    if stored.sizes["other"] != stored.sizes["mesh"]:
        return _at_orders(tree, stored, order, lambda others: _computed(tree, others).distances_table())
    return _at_orders(tree, stored.sel(other=labels), order, lambda others: _pairs_at(tree, meshes, others))


def _pairs_at(tree: xr.DataTree, meshes: xr.Dataset, others: tuple[float, ...]) -> xr.Dataset:
    """Return the distances of all pairs of meshes from their fields."""
    reducer, _ = stored_reducer(tree, others)
    rows: list[int] = meshes["row"].values.tolist()
    found = known_distances(reducer, rows, rows, set(reducer.complete)).named("distance")
    return describe(table_of(found, meshes, others, "mesh", "other").assign_coords(other=meshes["mesh"].values))


def norms_at(tree: xr.DataTree, order: Orders | None, meshes: Meshes = None) -> xr.Dataset:
    """Return the norms of an open store's meshes at some orders, in memory; see `convergence_at`."""
    stored = finished_group(tree, "norms", load=False)
    return _at_orders(tree, stored, order, lambda others: _computed(tree, others, meshes).norms_table()).load()


def _require_fields(tree: xr.DataTree, table: xr.Dataset, meshes: Sequence[str]) -> None:
    """Refuse labels of meshes that a table lacks, or that have no field."""
    labels, is_complete = table.indexes["mesh"], table["status"].values == "complete"
    for mesh, place in zip(meshes, labels.get_indexer(list(meshes)).tolist(), strict=True):
        if place < 0 or not is_complete[place]:
            raise _no_field(tree, mesh, labels[:3])


def _no_field(tree: xr.DataTree, mesh: str, known: Sequence[str]) -> InputError:
    return InputError(f"{source_of(tree)}: no mesh {quoted(mesh)} with a field; its labels begin {[*known]}")


def order_note(tree: xr.DataTree, orders: Sequence[float]) -> list[str]:
    """Return what orders that were computed from the fields rest on, as lines of a note of a table."""
    choice = store_of(tree).choice()
    frequencies = f"frequencies up to {choice.lattice.xi_max:g} on each axis"
    if choice.tail is not None:
        frequencies = f"{frequencies}, and samples in octaves up to {choice.tail.highest_frequency:.4g}"
    return [
        f"Not of the study, but computed now from its stored fields: order {', '.join(f'{s:g}' for s in orders)}.",
        f"They hold {frequencies}.",
        "What lies beyond is in the errors, which grow at orders nearer to -1/2.",
    ]


def _at_orders(
    tree: xr.DataTree, stored: xr.Dataset, order: Orders | None, compute: Callable[[tuple[float, ...]], xr.Dataset]
) -> xr.Dataset:
    """Return a table of an open store at some orders, or all of its own; those that it lacks are computed."""
    own: list[float] = stored["order"].values.tolist()
    chosen = own if order is None else list(check_orders(order))
    others = tuple(dict.fromkeys(s for s in chosen if s not in own))
    if not others:
        return stored.sel(order=chosen)
    computed, own = compute(others), [s for s in own if s in chosen]
    table = xr.concat(
        [*([stored.sel(mesh=computed["mesh"], order=own)] if own else []), computed],
        "order", data_vars="minimal", coords="minimal", compat="override", join="exact", combine_attrs="override",
    ).sel(order=chosen).load()  # fmt: skip
    # Both are of one state of the store.
    require_unchanged(tree)
    return table.assign_attrs({**stored.attrs, "computed": list(others)})


def _inner_bands(reducer: Reducer, rows: list[int]) -> list[Band]:
    lattice, orders = reducer.lattice, reducer.orders
    sums = np.zeros(lattice.shell_count)
    for number, block in enumerate(reducer.blocks):
        values = reducer.read(rows, number)
        sums += shell_sums(values[0] - values[1] if len(rows) > 1 else values[0], None, lattice, block)
    radii = lattice.spacing * np.sqrt(np.arange(lattice.shell_count))
    bands: list[Band] = []
    upper = lattice.xi_max
    while True:
        is_last = upper / 2 < _FEWEST_SPACINGS * lattice.spacing
        window = smooth_step(radii, upper) - (0.0 if is_last else smooth_step(radii, upper / 2))
        squares = np.array([np.sum(window * sums * (1 + radii**2) ** order) for order in orders])
        width = upper * (0.75 if is_last else 0.375)
        bands.insert(0, (upper, squares, float(np.sum(window * sums)) / width, 0.0))
        if is_last:
            return bands
        upper /= 2


def _octaves(reducer: Reducer, rows: list[int]) -> list[Band]:
    if reducer.sampling is None:
        return []
    values = [reducer.read_octaves(row) for row in rows]
    sums = reducer.octave_sums(values[0] - values[1] if len(rows) > 1 else values[0])
    return [
        (sampling.octave.highest, one.squares, one.energy, one.energy_deviation)
        for sampling, one in zip(reducer.sampling.octaves, sums, strict=True)
    ]
