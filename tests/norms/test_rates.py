"""Sequences of meshes against a surface: distances one by one, and the rates between them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb
from sobolev_batch.shapes import Sphere, icosphere


def test_distances_are_those_of_each_mesh_and_rates_those_between_them() -> None:
    meshes = {"fine": icosphere(3), "coarse": icosphere(1), "middle": icosphere(2)}
    seen: list[tuple[int, int]] = []
    found = sb.convergence(
        meshes, Sphere(), [-3.0, -5.0], lattice=sb.Lattice(3.0, 32), on_progress=lambda *step: seen.append(step)
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert found["mesh"].values.tolist() == list(meshes)
    for label, mesh in meshes.items():
        alone = sb.distance(mesh, Sphere(), [-3.0, -5.0], lattice=sb.Lattice(3.0, 32))
        for name in alone.data_vars:
            np.testing.assert_array_equal(found[name].sel(mesh=label), alone[name])
    values, edges = found["distance"], found["edge_length"]
    for coarse, fine in (("coarse", "middle"), ("middle", "fine")):
        by_hand = np.log(values.sel(mesh=coarse) / values.sel(mesh=fine)) / np.log(
            edges.sel(mesh=coarse) / edges.sel(mesh=fine)
        )
        np.testing.assert_allclose(found["rate"].sel(mesh=fine), by_hand, rtol=1e-12)
    assert found["rate"].sel(mesh="coarse").isnull().all()
    assert found["rate"].attrs["long_name"] == "observed order of convergence in the edge length"


def test_meshes_without_labels_are_numbered() -> None:
    found = sb.convergence([icosphere(1), icosphere(2)], icosphere(3), -4.0, rtol=5e-2)
    assert found["distance"].dims == ("mesh",)
    assert found["mesh"].values.tolist() == ["0", "1"]
    assert found["within"].all()


@pytest.mark.parametrize("meshes", [icosphere(1), "ball.ply"])
def test_one_mesh_is_no_list_of_meshes(meshes: Any) -> None:
    with pytest.raises(sb.errors.InputError, match="put it into a list"):
        sb.convergence(meshes, Sphere(), rtol=1e-2)


def test_a_mesh_that_is_refused_is_named() -> None:
    with pytest.raises(sb.errors.AccuracyError) as caught:
        sb.convergence({"coarse": icosphere(1), "fine": icosphere(2)}, Sphere(), rtol=1e-9)
    assert caught.value.__notes__ == ["This is mesh 'coarse', number 1 of 2."]


def test_no_meshes_are_refused() -> None:
    with pytest.raises(sb.errors.InputError, match="no meshes"):
        sb.convergence([], Sphere(), rtol=1e-2)
