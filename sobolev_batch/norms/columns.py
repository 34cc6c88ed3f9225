"""Datasets of norms and distances, with units, long names, and the lattice and kernel that they belong to."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sobolev_batch.arrays import Reals
from sobolev_batch.norms.estimate import PARTS, NormEstimate, ReferenceEstimate
from sobolev_batch.transform.lattice import AXES, Lattice, Orders, check_orders

# Values of variables, by name.
Columns = Mapping[str, NDArray[Any]]

KERNEL = "weight (1 + |xi|^2)^s, xi in cycles per unit length"
LENGTH, AREA, VOLUME = "unit length", "unit length squared", "unit length cubed"
FREQUENCY, NUMBER, ANGLE = "cycles per unit length", "1", "degree"
FILE_LENGTH = "unit length of the files"
# ||a||_s² = ∫ (1 + |ξ|²)^s |a^|² dξ is an area squared per volume.
NORM = "unit length^(1/2)"


def described(long_name: str, units: str = "", **others: str | int) -> dict[str, Any]:
    """Return the attributes of a variable, which may have no unit."""
    return {"long_name": long_name, **({"units": units} if units else {}), **others}


def _count(of: str) -> dict[str, Any]:
    # What is below `valid_min` is missing to readers of NetCDF. With `_FillValue`, xarray would make floats of it.
    return described(f"number of {of}", NUMBER, valid_min=0, description="-1 where it is not known")


# Between orders, numbers fall by powers.
_BETWEEN = "other orders: sobolev-batch table --order, or tree.sobolev.distance(order); interp is off by per cents"
# Attributes of variables by name, in the results of functions and in stores. The tables of a store have no others, so
# that the metadata of meshes may have any other name.
VARIABLES: Mapping[str, Mapping[str, Any]] = {
    "mesh": described("label of the mesh"),
    "other": described("label of the other mesh"),
    "object": described("name of the object"),
    "reference": described("label of the reference of the object"),
    "unit_length": described("unit of length in which the object was computed, in that of the files"),
    "order": described("Sobolev order s", NUMBER, description=_BETWEEN),
    "time": described("time of the mesh", description="in the unit of the study's times"),
    "fourier": described("Fourier transform of the area measure", convention="∫ exp(-2πi ξ·x) dμ(x)"),
    **{name: described(f"frequency along {name[-1]}", FREQUENCY) for name in AXES},
    "squared_distance": described("squared Sobolev distance", LENGTH),
    "gradient": described("derivative of the squared distance with respect to the vertices", NUMBER),
    "norm": described("Sobolev norm", NORM, kernel="(1 + |ξ|²)^s", description=_BETWEEN),
    "distance": described("Sobolev distance", NORM, kernel="(1 + |ξ|²)^s", description=_BETWEEN),
    "error": described("estimated error", NORM, description="the sum of error_part"),
    "error_part": described("part of the estimated error", NORM),
    "part": described(
        "cause of a part of the error",
        description="truncation: frequencies beyond the highest one, which only add on a given lattice; "
        "aliasing: spacing of the lattice; discretisation: quadrature and NUFFT; "
        "statistical: random frequencies, in 99 % of cases",
    ),
    "relative": described("distance over the norm of the reference", NUMBER, description=_BETWEEN),
    "relative_error": described("estimated error of the relative distance", NUMBER),
    "area_part": described("distance explained by a change of total area alone", NORM),
    "area_part_error": described("estimated error of that part", NORM),
    "shape_part": described("rest of the distance", NORM, description="the squares of both parts add up"),
    "shape_part_error": described("estimated error of the rest", NORM),
    "beyond": described("part of the square beyond the last octave", LENGTH, description="zero without octaves"),
    "area_share": described("share of the squared distance explained by a change of total area", NUMBER),
    "area_share_error": described("estimated error of that share", NUMBER),
    "moved": described("move of the reference that is like the distance", NUMBER, description="over its radius"),
    "moved_error": described("error of the move", NUMBER),
    "excess": described("relative excess of area over the reference", NUMBER),
    "rate": described("observed order of convergence in the edge length", NUMBER),
    "rate_error": described("estimated error of the rate", NUMBER),
    "resolved": described("distance exceeds its error"),
    "within": described("error is as small as requested"),
    "edge_length": described("mean edge length", LENGTH),
    "edge_length_mean": described("mean edge length", LENGTH),
    "edge_length_max": described("largest edge length", LENGTH),
    "area": described("area", AREA),
    "family": described("family of the mesh"),
    "name": described("name of the mesh in its family"),
    "is_reference": described("true for the reference, whose distance is zero"),
    "level": described("refinement level; -1 without levels", NUMBER),
    "rank": described("place in the family, from coarse to fine where it has such an order", NUMBER),
    "ordered_by": described("what orders the family: level, triangles, names or time"),
    "row": described("number of the mesh in /fourier", NUMBER),
    "status": described("complete, failed or missing"),
    "reason": described("reason of a failure"),
    "remark": described("what one should know of how the mesh was made"),
    "vertices": _count("vertices"),
    "triangles": _count("triangles"),
    "boundary_edges": _count("edges of one triangle"),
    "nonmanifold_edges": _count("edges of more than two triangles"),
    "inconsistent_edges": _count("edges whose two triangles face opposite sides"),
    "components": _count("parts that share no vertex"),
    "euler_characteristic": described("vertices less edges plus triangles", NUMBER, description="NaN if not known"),
    "volume": described("enclosed volume", VOLUME, description="negative for a mesh that is inside out"),
    "smallest_angle": described("smallest angle of the triangles", ANGLE),
    "aspect_ratio": described("largest aspect ratio of the triangles; 1 is equilateral", NUMBER),
    "duplicate_triangles": _count("triangles that repeat another"),
    "zero_area_triangles": _count("triangles without area"),
    "digest": described("SHA-256 of vertices and triangles"),
    "key": described("SHA-256 of all that the field depends on"),
    "points": _count("quadrature points"),
    "worker": described("address of the worker"),
    "backend": described("backend of the NUFFT"),
    "numerics": described("version of the numerics that computed the field", NUMBER),
    "finished": described("time of the end, in UTC"),
    "seconds": described("time spent in tasks", "s"),
    "make_seconds": described("time that making the mesh took", "s"),
    "make_cpu_seconds": described("processor time that making the mesh took", "s"),
    "make_peak_bytes": described("largest memory of the program that made the mesh", "byte"),
    "exit_status": described("exit status of the program that made the mesh; negative for a signal", NUMBER),
    **{
        f"{name}{way}": described(f"{title}, {whose}", ANGLE if name.startswith("normal") else FILE_LENGTH)
        for name, title in (
            ("hausdorff", "lower bound of the Hausdorff distance"),
            ("hausdorff_upper", "upper bound of the Hausdorff distance"),
            ("mean", "mean distance"),
            ("rms", "root mean square of distances"),
            *((f"p{percent}", f"distance within which {percent} % of the area is") for percent in (50, 95, 99)),
            ("normal_mean", "mean angle between normals"),
            ("normal_max", "largest angle between normals that was found"),
        )
        for way, whose in (
            ("", "the larger of both directions"),
            ("_forward", "from the mesh to the reference"),
            ("_backward", "from the reference to the mesh"),
        )
    },
    "mean_error": described("standard error of the mean distance", FILE_LENGTH),
    "rms_error": described("standard error of the root mean square", FILE_LENGTH),
    "bias": described("mean distance from the reference, positive outside and negative inside", FILE_LENGTH),
    "bias_error": described("standard error of the bias", FILE_LENGTH),
    "chamfer": described("Chamfer distance: the sum of both mean distances", FILE_LENGTH),
    "chamfer_error": described("standard error of the Chamfer distance", FILE_LENGTH),
    "fscore": described("F-score, the harmonic mean of precision and recall", NUMBER),
    "precision": described("fraction of the mesh within the threshold of the reference", NUMBER),
    "recall": described("fraction of the reference within the threshold of the mesh", NUMBER),
    "threshold": described("threshold of the F-score", FILE_LENGTH),
}


# Variables of results and columns of frames have these names.
TAKEN_NAMES = VARIABLES.keys() | set(PARTS)


def dataset_of(columns: Columns, dimensions: Sequence[str], coordinates: Mapping[Any, Any]) -> xr.Dataset:
    """Return values by name over some dimensions, and `error_part` over `part` besides, as a described dataset."""
    further = {"error_part": ("part",)}
    variables = {name: ((*dimensions, *further.get(name, ())), values) for name, values in columns.items()}
    names = {"part": np.array(PARTS, dtype=object)} if "error_part" in columns else {}
    return describe(xr.Dataset(variables, coords={**coordinates, **names}))


def parts_as_variables(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with a variable for each part of the error in place of `error_part`."""
    return dataset.drop_dims("part").assign(dataset["error_part"].to_dataset("part"))


def describe(dataset: xr.Dataset) -> xr.Dataset:
    """Add to variables the attributes that they lack, in place, and return the dataset."""
    for name, variable in dataset.variables.items():
        variable.attrs = {**VARIABLES.get(str(name), {}), **variable.attrs}
    return dataset


def order_axis(order: Orders) -> tuple[tuple[str, ...], Reals, dict[str, str]]:
    """Return the coordinate `order`: a dimension for several orders, each once, a scalar for one."""
    orders = np.reshape(check_orders(order), (-1,) * np.ndim(order))
    return ("order",) * orders.ndim, orders, dict(VARIABLES["order"])


def labelled(order: Orders, values: Mapping[str, Reals], attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return values (orders,) by name over the dimension `order`, or without dimensions for a single order."""
    axis = order_axis(order)
    columns = {name: np.reshape(value, (*axis[1].shape, *np.shape(value)[1:])) for name, value in values.items()}
    return dataset_of(columns, axis[0], {"order": axis}).assign_attrs({"kernel": KERNEL, **attributes})


def labelled_distances(
    order: Orders, distances: NormEstimate, reference: ReferenceEstimate, attributes: Mapping[str, object]
) -> xr.Dataset:
    """Return distances and what they are relative to the reference, in the form of `labelled`."""
    relative, shares = distances.relative_to(reference.norms), reference.area_shares(distances)
    columns = {**distances.named("distance"), **relative, **shares, "excess": reference.excesses}
    return labelled(order, columns, attributes)


def lattice_attributes(lattice: Lattice, *fields: xr.DataArray) -> dict[str, Any]:
    """Return the attributes of a dataset that was computed from fields on a lattice."""
    dtypes = dict.fromkeys(str(field.dtype) for field in fields)
    return {"kernel": KERNEL, "xi_max": lattice.xi_max, "M": lattice.M, "dtype": ", ".join(dtypes)}
