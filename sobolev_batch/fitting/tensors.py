"""Squared distances as differentiable functions of tensors, for PyTorch and JAX."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sobolev_batch.errors import InputError
from sobolev_batch.fitting.gradient import SquaredDistance


def torch_function(squared: SquaredDistance) -> Callable[[Any], Any]:
    """Return a squared distance as a differentiable function of a PyTorch tensor.

    Args:
        squared: The squared distance.

    Returns:
        Function of a tensor of vertices, (n, 3) or (3n,), that returns a scalar tensor of the same dtype and device. It
        computes in double precision on the processor; a double tensor there is read without a copy. It can be
        differentiated once. Errors are those of `SquaredDistance`.

    Raises:
        InputError: PyTorch is not installed.

    >>> import sobolev_batch as sb
    >>> ball = sb.icosphere(1)
    >>> squared = sb.SquaredDistance.for_mesh(ball, sb.Sphere(1.1), -2.0, lattice=sb.Lattice(2.0, 20))
    >>> function = sb.torch_function(squared)  # doctest: +SKIP
    >>> function(torch.tensor(ball.vertices, requires_grad=True)).backward()  # doctest: +SKIP
    """
    try:
        import torch
        from torch.autograd.function import once_differentiable
    except ImportError as error:
        raise _missing("PyTorch", "torch") from error

    class _Function(torch.autograd.Function):  # type: ignore[misc]
        @staticmethod
        def forward(context: Any, vertices: Any) -> Any:
            positions = vertices.detach().cpu().numpy()
            if not context.needs_input_grad[0]:
                return vertices.new_tensor(squared.value(positions))
            value, gradient = squared(positions)
            context.save_for_backward(torch.from_numpy(gradient).to(vertices))
            return vertices.new_tensor(value)

        @staticmethod
        @once_differentiable
        def backward(context: Any, slope: Any) -> Any:
            (gradient,) = context.saved_tensors
            return slope * gradient

    function: Callable[[Any], Any] = _Function.apply
    return function


def jax_function(squared: SquaredDistance) -> Callable[[Any], Any]:
    """Return a squared distance as a differentiable function of a JAX array.

    Args:
        squared: The squared distance.

    Returns:
        Function of an array of vertices, (n, 3) or (3n,), that returns a scalar of the same dtype. It works under
        `jax.jit` and `jax.grad`, and computes in double precision on the host. It can be differentiated once, in
        reverse mode. JAX passes errors of `SquaredDistance` on as its own.

    Raises:
        InputError: JAX is not installed.

    >>> import sobolev_batch as sb
    >>> ball = sb.icosphere(1)
    >>> squared = sb.SquaredDistance.for_mesh(ball, sb.Sphere(1.1), -2.0, lattice=sb.Lattice(2.0, 20))
    >>> function = sb.jax_function(squared)  # doctest: +SKIP
    >>> gradient = jax.grad(function)(jax.numpy.asarray(ball.vertices))  # doctest: +SKIP
    """
    try:
        import jax
    except ImportError as error:
        raise _missing("JAX", "jax") from error

    def value(vertices: Any) -> Any:
        found = np.asarray(squared.value(np.asarray(vertices)))
        return found.astype(vertices.dtype)

    def value_and_gradient(vertices: Any) -> tuple[Any, Any]:
        found, gradient = squared(np.asarray(vertices))
        return np.asarray(found).astype(vertices.dtype), gradient.astype(vertices.dtype)

    def forward(vertices: Any) -> tuple[Any, Any]:
        shapes = jax.ShapeDtypeStruct((), vertices.dtype), jax.ShapeDtypeStruct(vertices.shape, vertices.dtype)
        found: tuple[Any, Any] = jax.pure_callback(value_and_gradient, shapes, vertices)
        return found

    def backward(gradient: Any, slope: Any) -> tuple[Any]:
        return (slope * gradient,)

    @jax.custom_vjp
    def function(vertices: Any) -> Any:
        return jax.pure_callback(value, jax.ShapeDtypeStruct((), vertices.dtype), vertices)

    function.defvjp(forward, backward)
    result: Callable[[Any], Any] = function
    return result


def _missing(name: str, extra: str) -> InputError:
    return InputError(f"{name} is not installed; the extra has it: pip install 'sobolev-batch[{extra}]'")
