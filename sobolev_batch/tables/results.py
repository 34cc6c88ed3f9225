"""The results of a reduction as datasets: norms, distances and observed rates of meshes, in the order of tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.accuracy.tolerance import Accuracy
from sobolev_batch.norms.columns import dataset_of, describe
from sobolev_batch.norms.estimate import AREA_AND_SHAPE, NormEstimate
from sobolev_batch.norms.rates import observed_rates
from sobolev_batch.sources.programs import Cost
from sobolev_batch.tables.reducer import Reducer
from sobolev_batch.tables.shells import chunks_of_spectra, read_spectra

# Columns of the table of meshes that all tables have as coordinates, besides times and other metadata.
_IDENTITY = ("family", "name", "is_reference", "level", "status")
COORDINATES = (*_IDENTITY, "vertices", "triangles", "edge_length_mean", "seconds")
# Those that only some studies have.
SOME_COORDINATES = {"time", *(item.name for item in fields(Cost))}
# What orders families that go from coarse to fine.
FROM_COARSE_TO_FINE = ("level", "triangles")


@dataclass(frozen=True, eq=False)
class Results:
    """The results of a reduction in the order of tables, NaN where there are none.

    Attributes:
        norms, to_reference: Norms, and distances to the reference, each (orders, meshes).
        parts: (4, orders, meshes), the distance's parts of area and shape, each with its error; see `AREA_AND_SHAPE`.
        beyond: (2, orders, meshes), see `Compared`.
    """

    meshes: xr.Dataset
    reference: str
    orders: tuple[float, ...]
    norms: NormEstimate
    to_reference: NormEstimate
    parts: Reals
    beyond: Reals

    @classmethod
    def from_spectra(cls, reducer: Reducer, meshes: xr.Dataset, reference: str) -> Self:
        """Return norms, and distances to the reference, from the spectra that the reducer's store holds."""
        count, orders = meshes.sizes["mesh"], len(reducer.orders)
        arrays = [np.full((parts, orders, count), np.nan) for parts in (5, 5, 4, 2)]
        places = {row: place for place, row in enumerate(meshes["row"].values.tolist())}
        complete = {row for row in reducer.complete if row in places}
        of_reference = None if reducer.reference is None else read_spectra(reducer.store, [reducer.reference]).norm
        for chunk in chunks_of_spectra(reducer.store):
            rows = [row for row in chunk if row in complete]
            if rows:
                found = reducer.norms_of(rows, read_spectra(reducer.store, rows), of_reference)
                parts = [*found.reference.area_and_shape(found.distances).values()]
                of_rows = [places[row] for row in rows]
                numbers = found.norms.stacked, found.distances.stacked, np.stack(parts), np.stack(found.beyond)
                for array, values in zip(arrays, numbers, strict=True):
                    array[..., of_rows] = values
        norms, to_reference, *others = arrays
        return cls(meshes, reference, reducer.orders, NormEstimate(*norms), NormEstimate(*to_reference), *others)

    def norms_table(self) -> xr.Dataset:
        """Return `norm` (mesh, order) with its error."""
        columns = {**self.norms.named("norm"), "beyond": self.beyond[0]}
        return table_of(columns, self.meshes, self.orders)

    def distances_table(self) -> xr.Dataset:
        """Return `distance` (mesh, other, order) with its error; the only other is the reference."""
        distances = {name: values[:, :, None] for name, values in self.to_reference.named("distance").items()}
        table = table_of(distances, self.meshes, self.orders, "mesh", "other")
        return describe(table.assign_coords(other=("other", np.array([self.reference], dtype=object))))

    def convergence_table(self, accuracy: Accuracy | None) -> xr.Dataset:
        """Return distances to the reference, relative ones and their parts, and observed orders of convergence."""
        sizes = self.meshes["edge_length_mean"].to_numpy()
        reference = self.meshes.indexes["mesh"].get_loc(self.reference)
        distances, errors = self.to_reference.values, self.to_reference.errors
        families, ordered_by = (self.meshes[name].values for name in ("family", "ordered_by"))
        rates, rate_errors = rates_in_families(families, ordered_by, distances, errors, sizes)
        relative, relative_errors = self.to_reference.relative_to(NormEstimate(*self.norms.stacked[..., [reference]]))
        columns = {
            **self.to_reference.named("distance"),
            "relative": relative,
            "relative_error": relative_errors,
            **dict(zip(AREA_AND_SHAPE, self.parts, strict=True)),
            "beyond": self.beyond[1],
            "rate": rates,
            "rate_error": rate_errors,
            "resolved": errors < distances,
            "within": np.ones_like(distances, dtype=bool) if accuracy is None else accuracy.met(self.to_reference),
        }
        attributes = {"reference": self.reference, **({} if accuracy is None else {"rtol": accuracy.rtol})}
        return table_of(columns, self.meshes, self.orders).assign_attrs(attributes)


def rates_in_families(
    families: NDArray[Any], ordered_by: NDArray[Any], distances: Reals, errors: Reals, sizes: Reals
) -> Reals:
    """Return observed rates and their errors (2, orders, meshes); NaN in families that are not from coarse to fine."""
    rates, is_ordered = np.full((2, *distances.shape), np.nan), np.isin(ordered_by, FROM_COARSE_TO_FINE)
    for family in dict.fromkeys(families[is_ordered].tolist()):
        members = is_ordered & (families == family)
        for k in range(len(distances)):
            rates[:, k, members] = observed_rates(distances[k, members], errors[k, members], sizes[members])
    return rates


def table_of(
    columns: Mapping[str, NDArray[Any]], meshes: xr.Dataset, orders: Sequence[float], *dimensions: str
) -> xr.Dataset:
    """Return values (orders, ...) by name over dimensions (default "mesh") and the order, as a table of meshes."""
    dimensions = dimensions or ("mesh",)
    moved = {name: np.moveaxis(values, 0, len(dimensions)) for name, values in columns.items()}
    return dataset_of(moved, (*dimensions, "order"), coordinates_of(meshes, orders).variables)


def coordinates_of(meshes: xr.Dataset, orders: Sequence[float]) -> xr.Dataset:
    """Return the coordinates that every table has, from the table of meshes."""
    names = [*COORDINATES, *sorted(SOME_COORDINATES & meshes.coords.keys()), *meshes.attrs.get("metadata", ())]
    coordinates = meshes.reset_coords()[names].rename(edge_length_mean="edge_length")
    return describe(
        xr.Dataset(coords={**coordinates.variables, "order": ("order", np.array(orders, dtype=np.float64))})
    )
