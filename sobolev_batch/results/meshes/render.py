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
from sobolev_batch.results.meshes.views import Portrait

# (k, height, width, 3), in red, green and blue.
Pictures = NDArray[np.uint8]

_EASEL = Path(__file__).with_name("_render_process.py")
# A processor draws a picture within a second or two.
_PATIENCE_SECONDS = 300.0
_REMEDY = (
    "drawing without a display takes EGL and a renderer, on Debian and Ubuntu: "
    "apt-get install libegl1 libgl1-mesa-dri libx11-6"
)


def render(portraits: Sequence[Portrait], orders: int, side: int = 900, *, common: bool = False) -> list[Pictures]:
    """Draw each mesh from the front and above, once for each of its first orders.

    Red where the witness is positive, blue where it is negative, as matplotlib's "RdBu_r" between plus and
    minus the numbers that `scales` tells.

    Args:
        portraits: the meshes.
        orders: of each, at most.
        side: the longer one of each picture, in dots.
        common: colour all meshes on one scale.

    Raises:
        InputError: VTK is not installed, or cannot draw here.
    """
    if not portraits:
        return []
    if find_spec("pyvista") is None:
        raise InputError(
            "drawing meshes takes the library pyvista, which is not installed; "
            "the extra has it: pip install 'sobolev-batch[vtk]'"
        )
    scene: dict[str, Any] = {"count": np.array(len(portraits)), "side": np.array(side)}
    for i, (portrait, limits) in enumerate(zip(portraits, scales(portraits, common), strict=True)):
        scene |= {
            f"limits_{i}": limits[:orders],
            f"vertices_{i}": portrait.vertices,
            f"triangles_{i}": portrait.triangles,
            f"values_{i}": portrait.values[:orders],
        }
    with tempfile.TemporaryDirectory(prefix="sobolev-") as folder:
        files = Path(folder, "scene.npz"), Path(folder, "pictures.npz")
        np.savez(files[0], **scene)
        _draw(*files)
        with np.load(files[1], allow_pickle=False) as found:
            return [found[f"picture_{i}"] for i in range(len(portraits))]


def scales(portraits: Sequence[Portrait], common: bool) -> list[NDArray[np.float64]]:
    """Where the colours of each mesh end, for each order: at its largest modulus, or at that of all meshes."""
    largest = [np.abs(portrait.values).max(axis=1) for portrait in portraits]
    if common:
        largest = [np.max(largest, axis=0)] * len(portraits)
    return [np.where(limits > 0, limits, 1.0) for limits in largest]


def _draw(scene: Path, pictures: Path) -> None:
    """In a process of its own: VTK does not raise where it finds no OpenGL, it crashes."""
    environment = dict(os.environ)
    if sys.platform == "linux":
        # A display would be tried first, which may be far away or gone; if there is no EGL, OSMesa is next.
        environment.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    # -P: modules beside the program have the names of other libraries.
    command = [sys.executable, "-P", str(_EASEL), str(scene), str(pictures)]
    try:
        done = subprocess.run(  # noqa: S603
            command, env=environment, cwd=scene.parent, capture_output=True, timeout=_PATIENCE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"meshes cannot be drawn here: VTK took more than {_PATIENCE_SECONDS:g} s") from error
    if done.returncode:
        raise InputError(f"meshes cannot be drawn here: {_reason(done.returncode, done.stderr)}; {_REMEDY}")


def _reason(status: int, errors: bytes) -> str:
    if status < 0:
        return f"VTK crashed ({signal.strsignal(-status) or f'signal {-status}'})"
    lines = errors.decode(errors="replace").strip().splitlines()
    return f"VTK failed ({lines[-1] if lines else f'exit status {status}'})"
