"""Squared distances of tensors: the same values and derivatives, in training loops too."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import sobolev_batch as sb

BALL = sb.icosphere(1)


@pytest.fixture(scope="module")
def squared() -> sb.SquaredDistance:
    return sb.SquaredDistance.for_mesh(BALL, sb.Sphere(1.1), -2.0, lattice=sb.Lattice(2.0, 20))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_torch_gives_the_same(squared: sb.SquaredDistance, dtype: str) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch comes with the extra 'torch'")
    value, gradient = squared(BALL.vertices)
    vertices = torch.tensor(np.array(BALL.vertices), dtype=getattr(torch, dtype), requires_grad=True)
    found = sb.torch_function(squared)(vertices)
    (3 * found).backward()
    assert found.dtype == vertices.grad.dtype == vertices.dtype
    tolerance = 1e-12 if dtype == "float64" else 1e-4
    assert found.item() == pytest.approx(value, rel=tolerance)
    np.testing.assert_allclose(vertices.grad.numpy(), 3 * gradient, rtol=0, atol=tolerance * np.abs(gradient).max())


def test_torch_learns_in_a_loop(squared: sb.SquaredDistance) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch comes with the extra 'torch'")
    function = sb.torch_function(squared)
    radius = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    directions = torch.tensor(np.array(BALL.vertices))
    optimizer = torch.optim.SGD([radius], lr=5e-4)
    losses = []
    for _ in range(30):
        optimizer.zero_grad()
        loss = function(radius * directions)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 50
    with torch.no_grad():
        assert function(radius * directions).item() == pytest.approx(squared.value(radius.item() * BALL.vertices))


def test_torch_says_what_is_wrong(squared: sb.SquaredDistance) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch comes with the extra 'torch'")
    with pytest.raises(sb.InputError, match="the mesh has 42 vertices"):
        sb.torch_function(squared)(torch.zeros(5, 3))


@pytest.mark.parametrize("compiled", [False, True])
def test_jax_gives_the_same(squared: sb.SquaredDistance, compiled: bool) -> None:
    jax = pytest.importorskip("jax", reason="JAX comes with the extra 'jax'")
    value, gradient = squared(BALL.vertices)
    function: Any = jax.value_and_grad(lambda vertices: 3 * sb.jax_function(squared)(vertices))
    found, slopes = (jax.jit(function) if compiled else function)(jax.numpy.asarray(np.array(BALL.vertices)))
    assert float(found) == pytest.approx(3 * value, rel=1e-4)
    np.testing.assert_allclose(np.asarray(slopes), 3 * gradient, rtol=0, atol=1e-4 * np.abs(gradient).max())
    assert float(sb.jax_function(squared)(jax.numpy.asarray(np.array(BALL.vertices)))) == pytest.approx(value, rel=1e-4)


def test_jax_learns_in_a_loop(squared: sb.SquaredDistance) -> None:
    jax = pytest.importorskip("jax", reason="JAX comes with the extra 'jax'")
    function, directions = sb.jax_function(squared), jax.numpy.asarray(np.array(BALL.vertices))
    step = jax.jit(jax.value_and_grad(lambda radius: function(radius * directions)))
    radius, losses = 1.0, []
    for _ in range(20):
        loss, slope = step(radius)
        radius = radius - 5e-4 * float(slope)
        losses.append(float(loss))
    assert losses[-1] < losses[0] / 50


@pytest.mark.parametrize(("library", "name"), [("torch", "PyTorch"), ("jax", "JAX")])
def test_a_missing_library_is_named(
    squared: sb.SquaredDistance, library: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(sb.InputError, match=rf"{name} is not installed; .* pip install 'sobolev-batch\[{library}\]'"):
        getattr(sb, f"{library}_function")(squared)
