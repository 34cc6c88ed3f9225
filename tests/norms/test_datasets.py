"""Labels of the datasets of metrics: units, long names, the lattice and the kernel."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from sobolev_batch import Lattice, distance, fourier_transform, norm, spectrum, witness
from sobolev_batch.errors import DamageError
from sobolev_batch.norms.fields import Quality
from sobolev_batch.norms.tail.remainder import Remainder
from sobolev_batch.shapes import Sphere, icosphere

LATTICE = Lattice(2.0, 16)
A, B = fourier_transform(icosphere(1), LATTICE), fourier_transform(Sphere(), LATTICE, dtype="complex64")
POINTS = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
METRICS: dict[str, Callable[[list[float]], xr.Dataset]] = {
    "norm": lambda order: norm(A, order),
    "distance": lambda order: distance(A, B, order),
    "spectrum": lambda order: spectrum(A, B, order),
    "witness": lambda order: witness(A, B, order, POINTS).to_dataset(promote_attrs=True),
}


@pytest.mark.parametrize("name", METRICS)
def test_every_number_has_a_unit_and_a_name(name: str) -> None:
    dataset = METRICS[name]([-2.0, -3.0])
    assert dataset.attrs["kernel"] == "weight (1 + |xi|^2)^s, xi in cycles per unit length"
    assert (dataset.attrs["xi_max"], dataset.attrs["M"]) == (2.0, 16)
    assert dataset.attrs["dtype"] == ("complex128" if name == "norm" else "complex128, complex64")
    for variable in dataset.variables:
        assert dataset[variable].attrs["long_name"], variable
        assert dataset[variable].dtype == object or dataset[variable].attrs["units"], variable
    assert dataset["order"].values.tolist() == [-2.0, -3.0]


@pytest.mark.parametrize(
    ("place", "entry"),
    [(0, "x"), (1, [0.0]), (3, "x"), (5, []), (5, 0), (5, {"radii": []}), (6, 0), (6, [1.0]), (6, {"cutoff": 1.0})],
)
def test_what_is_no_quality_of_a_field_is_damage(place: int, entry: object) -> None:
    parts = json.loads(A.attrs["quality"])
    parts[place] = entry
    for text in (json.dumps(parts), json.dumps(parts[:6])):
        with pytest.raises(DamageError, match="its quality cannot be read"):
            norm(A.assign_attrs(quality=text), -2.0)


def test_errors_beside_a_field_of_unknown_quality_are_all_unknown() -> None:
    quality = replace(Quality.from_json(A.attrs["quality"]), beyond=Remainder.alike(2.0, 0.5, 0.5))
    found = distance(A.assign_attrs(quality=quality.to_json()), (2 * A).drop_attrs(), -2.0)
    assert found["error_part"].isnull().all()


def test_settings_of_an_accuracy_are_attributes_and_closed_forms_have_none() -> None:
    assert set(distance(Sphere(), Sphere(0.5), -2.0).attrs) == {"kernel"}
    dataset = distance(icosphere(0), Sphere(), [-5.0], rtol=0.1)
    assert dataset["within"].attrs["long_name"]
    chosen = {"kernel", "rtol", "xi_max", "M", "octaves", "highest_frequency", "seed"}
    assert chosen | {"dtype", "eps", "quadrature_eps", "points"} == set(dataset.attrs)


def test_witness_keeps_the_points() -> None:
    values = witness(A, B, [-2.0], POINTS)
    assert np.array_equal(np.stack([values[axis].values for axis in "xyz"], axis=1), POINTS)
    assert values["x"].dims == ("point",)
