"""The distance of a pair and all parts of its error are the same, whoever computes them from the same fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client
from numpy.typing import NDArray

import sobolev_batch as sb
from sobolev_batch.norms.estimate import AREA_AND_SHAPE, PARTS, NormEstimate
from sobolev_batch.tables.other_orders import distances_at, stored_evaluator
from tests.support.rectangles import Rectangles
from tests.support.studies import small_table, variable

STORED, OTHERS = [-1.5, -3.0], [-2.0, -4.0]
MESH, TWIN = "ico/1", "twin/sphere"


def study_of(octaves: int) -> sb.Study:
    """Return a study with a mesh that has the surface of the reference, and no other extent than that one."""
    families = [{"name": "ico", "source": "icosphere", "levels": [1, 2]}, {"name": "twin", "source": "sphere"}]
    lattice = {"xi_max": 3.0, "M": 16, **({"octaves": octaves} if octaves else {})}
    return sb.Study.from_table(small_table(lattice=lattice, norm={"orders": STORED}, family=families))


def parts_of(found: xr.Dataset) -> NDArray[np.float64]:
    """Return a distance and the parts of its error (orders, 5)."""
    return np.concatenate([found["distance"].values[:, None], found["error_part"].values], axis=1)


@pytest.mark.parametrize("orders", [STORED, OTHERS])
def test_on_a_lattice_functions_tables_matrices_and_accessors_agree(
    orders: list[float], store_path: Path, threads: Client
) -> None:
    sb.run(study_of(0), store_path, threads)
    tree = sb.open_store(store_path)
    fields = variable(tree, "fourier", "fourier")
    of_fields = sb.distance(fields.sel(mesh=MESH), fields.sel(mesh="reference"), orders)
    expected = parts_of(of_fields)
    assert (expected[:, :4] > 0).all()
    table, pairs = sb.table(tree, orders), distances_at(tree, orders).sel(mesh=MESH)
    of_spectra, against_twin = tree.sobolev.distance(orders, MESH), tree.sobolev.distance(orders, MESH, TWIN)
    for found in (
        table[table["mesh"] == MESH][["distance", *PARTS]].to_numpy(),
        *(parts_of(pairs.sel(other=other).transpose("order", "part")) for other in ("reference", TWIN)),
        parts_of(of_spectra),
        parts_of(against_twin),
    ):
        # Errors are differences of roots, in which digits cancel.
        assert found == pytest.approx(expected, rel=1e-7, abs=0)
    for found in (of_spectra, against_twin):
        for name in ("relative", "relative_error"):
            assert found[name].values == pytest.approx(of_fields[name].values, rel=1e-7)
        share = (found["area_part"] / found["distance"]).values ** 2
        assert share == pytest.approx(of_fields["area_share"].values, rel=1e-7)
    for name in AREA_AND_SHAPE:
        assert of_spectra[name].values == pytest.approx(against_twin[name].values, rel=1e-7)


def test_flat_faces_that_repeat_beyond_a_given_lattice_are_in_every_error(store_path: Path, threads: Client) -> None:
    strips = {"reference": (20, 0.0), "f/moved": (20, 0.1), "f/other": (19, 0.0)}
    surfaces = {label: Rectangles.strips(*count_and_offset, 1.0, 0.5) for label, count_and_offset in strips.items()}
    for label, surface in surfaces.items():
        sb.write_mesh(surface.mesh(), store_path.parent / f"{label.removeprefix('f/')}.ply")
    settings = {"lattice": {"xi_max": 4.0, "M": 24}, "norm": {"orders": STORED}, "scaling": {"mode": "none"}}
    families = [{"name": "f", "source": "files", "paths": ["moved.ply", "other.ply"]}]
    made = small_table(**settings, family=families, reference={"source": "files", "paths": ["reference.ply"]})
    sb.run(sb.Study.from_table(made, folder=store_path.parent), store_path, threads)
    tree, orders = sb.open_store(store_path), [-1.3, *STORED]
    fields = variable(tree, "fourier", "fourier")
    itself = sb.distance(fields.sel(mesh="f/moved"), fields.sel(mesh="f/moved"), orders)
    assert (itself["error_part"].sel(part="truncation") == 0).all()
    for mesh, other in (("f/moved", "reference"), ("f/other", "reference"), ("f/moved", "f/other")):
        found = sb.distance(fields.sel(mesh=mesh), fields.sel(mesh=other), orders)
        expected = tree.sobolev.distance(orders, mesh, other)["error"].values
        assert (np.abs(found["distance"] - surfaces[mesh].distance(surfaces[other], orders)) <= expected).all()
        assert distances_at(tree, orders).sel(mesh=mesh, other=other)["error"].values == pytest.approx(expected, 1e-4)
        # Fields may come from two studies.
        assert (found["error"].values >= (1 - 1e-4) * expected).all()
        if other == "reference":
            meshes = surfaces[mesh].mesh(), surfaces[other].mesh()
            given = sb.distance(*meshes, orders, lattice=sb.Lattice(4.0, 24))["error"].values
            # The orders between which it is interpolated are others.
            assert expected == pytest.approx(given, rel=0.2)


def test_with_octaves_stored_spectra_fields_and_tiles_of_pairs_agree(store_path: Path, threads: Client) -> None:
    sb.run(study_of(2), store_path, threads)
    tree = sb.open_store(store_path)
    evaluator, (row, reference) = stored_evaluator(tree, OTHERS, MESH, "reference")
    of_spectra = tree.sobolev.distance(OTHERS, MESH)
    of_fields = evaluator.norms([row])
    expected = parts_of(of_spectra)
    assert (expected > 0).all()
    assert np.moveaxis(of_fields.distances.stacked, 0, -1)[:, 0] == pytest.approx(expected, rel=1e-9)
    for name, values in of_fields.reference.area_and_shape(of_fields.distances).items():
        assert of_spectra[name].values == pytest.approx(values[:, 0], rel=1e-9)
    pair: NormEstimate = evaluator.pairs([row], [reference])
    found = pair.stacked[..., 0, 0].T
    assert found[:, :4] == pytest.approx(expected[:, :4], rel=1e-7)
    # Of stored spectra the largest sample is known at some orders, and bounded between them.
    assert found[:, 4] == pytest.approx(expected[:, 4], rel=0.05)


def test_what_is_certainly_zero_is_so_over_a_norm_that_is_not_resolved(store_path: Path, threads: Client) -> None:
    sb.run(sb.Study.from_table(small_table(norm={"orders": [-0.51]})), store_path, threads)
    tree = sb.open_store(store_path)
    norm = tree["norms"].to_dataset().sel(mesh="reference").squeeze()
    assert norm["error"].item() > norm["norm"].item()
    found = tree["convergence"].to_dataset().squeeze("order")
    names = ["distance", "error", "relative", "relative_error", *AREA_AND_SHAPE]
    assert not any(found[name].sel(mesh="reference").item() for name in names)
    assert np.isnan(found["relative_error"].sel(mesh="ico/1").item())
