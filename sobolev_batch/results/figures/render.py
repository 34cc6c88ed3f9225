"""Meshes drawn off screen, coloured by their witness functions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sobolev_batch.errors import InputError
from sobolev_batch.results.figures.views import MeshView

# Pictures (k, height, width, 3) in red, green and blue.
Pictures = NDArray[np.uint8]

_PROGRAM = Path(__file__).with_name("_render_process.py")
_REMEDY = (
    "drawing without a display needs EGL and a renderer, on Debian and Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri libx11-6"
)


def render(
    views: Sequence[MeshView],
    orders: int,
    side: int = 900,
    *,
    common: bool = False,
    program: Path = _PROGRAM,
    timeout_seconds: float = 300.0,
) -> list[Pictures]:
    """Draw each mesh from the side of its eye, once for each of its first orders.

    Red where the witness is positive and blue where it is negative: Matplotlib's "RdBu_r" between plus and
    minus `color_limits`.

    Args:
        views: Meshes to draw.
        orders: Number of orders of each, at most.
        side: Longer side of each picture, in pixels.
        common: Colour all meshes on one scale.
        program: Program that draws.
        timeout_seconds: Time for all pictures, at a second or two of a processor each.

    Raises:
        InputError: VTK is not installed, or cannot draw on this machine.
    """
    if not views:
        return []
    if find_spec("pyvista") is None:
        raise InputError(
            "drawing meshes needs the library pyvista, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[vtk]'"
        )
    scene: dict[str, Any] = {"count": np.array(len(views)), "side": np.array(side)}
    for i, (view, limits) in enumerate(zip(views, color_limits(views, common), strict=True)):
        scene |= {
            f"limits_{i}": limits[:orders],
            f"eye_{i}": view.eye,
            f"vertices_{i}": view.vertices,
            f"triangles_{i}": view.triangles,
            f"values_{i}": view.values[:orders],
        }
    with tempfile.TemporaryDirectory(prefix="sobolev-") as folder:
        files = Path(folder, "scene.npz"), Path(folder, "pictures.npz")
        np.savez(files[0], **scene)
        _draw([str(program), *map(str, files)], Path(folder), timeout_seconds)
        with np.load(files[1], allow_pickle=False) as pictures:
            return [pictures[f"picture_{i}"] for i in range(len(views))]


def color_limits(views: Sequence[MeshView], common: bool) -> list[NDArray[np.float64]]:
    """Return the end of the scale of colours for each order, of each mesh or the same for all of them."""
    limits = [view.color_limits for view in views]
    return [np.max(limits, axis=0)] * len(views) if common else limits


def _draw(arguments: Sequence[str], folder: Path, timeout_seconds: float) -> None:
    """Draw in a process of its own: without OpenGL, VTK crashes instead of raising."""
    environment = dict(os.environ)
    if sys.platform == "linux":
        # Otherwise VTK tries a display first, which may be remote or gone. Without EGL it takes OSMesa.
        environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    # -P keeps modules beside the program from shadowing libraries of the same name.
    command = [sys.executable, "-P", *arguments]
    try:
        done = subprocess.run(  # noqa: S603
            command, env=environment, cwd=folder, capture_output=True, timeout=timeout_seconds, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"meshes cannot be drawn here: VTK took more than {timeout_seconds:g} s") from error
    if done.returncode:
        raise InputError(f"meshes cannot be drawn here: {_reason(done.returncode, done.stderr)}; {_REMEDY}")


def _reason(status: int, errors: bytes) -> str:
    if status < 0:
        return f"VTK crashed ({signal.strsignal(-status) or f'signal {-status}'})"
    lines = errors.decode(errors="replace").strip().splitlines()
    return f"VTK failed ({lines[-1] if lines else f'exit status {status}'})"
