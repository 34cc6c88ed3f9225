"""Program that draws meshes off screen, in a process that VTK may end where it finds no OpenGL.

`render` runs it as ``python _render_process.py SCENE PICTURES``. It imports nothing of the package, whose path it does
not know. SCENE holds the arrays ``count`` and ``side``, and for each mesh i ``vertices_i``, ``triangles_i``,
``values_i`` (k, vertices), the colour limits ``limits_i`` (k,) and the direction to the viewer ``eye_i`` (3,). PICTURES
gets ``picture_i`` (k, height, width, 3).
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pyvista

_UP = (0.0, 0.0, 1.0)
# Margin around the mesh, as a fraction of the picture's side.
_MARGIN = 0.02
# White light from above the viewer's left shoulder, dim enough to keep colours distinct and bright enough for shapes.
_LIGHT = (-0.5, 0.7, 1.5)
_AMBIENT = 0.62
# Angle in degrees; where two faces meet at a larger one, the edge is drawn sharp.
_SHARP = 60.0
_ARRAYS = ("vertices", "triangles", "values", "limits", "eye")


def main(scene_path: str, pictures_path: str) -> None:
    """Draw all meshes of a scene."""
    scene = np.load(scene_path, allow_pickle=False)  # noqa: TID251
    side = int(scene["side"])
    pictures = {
        f"picture_{i}": _pictures(*(scene[f"{name}_{i}"] for name in _ARRAYS), side=side)
        for i in range(int(scene["count"]))
    }
    np.savez(pictures_path, **pictures)


def _pictures(vertices: Any, triangles: Any, values: Any, limits: Any, eye: Any, *, side: int) -> Any:
    threes = np.full((len(triangles), 1), 3)
    mesh = pyvista.PolyData(vertices, np.hstack([threes, triangles]).ravel())
    right = np.cross(_UP, eye)
    right /= np.linalg.norm(right)
    plane = np.stack([right, np.cross(eye, right)], axis=1)
    projected = vertices @ plane
    low, high = projected.min(axis=0), projected.max(axis=0)
    scale = (1 - 2 * _MARGIN) * side / (high - low).max()
    size = [round(scale * extent + 2 * _MARGIN * side) for extent in high - low]
    center = (low + high) / 2 @ plane.T
    pictures = []
    for row, largest in zip(values, limits, strict=True):
        plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
        plotter.add_light(pyvista.Light(light_type="camera light", position=_LIGHT))
        plotter.background_color = "white"
        plotter.enable_anti_aliasing("ssaa")
        plotter.add_mesh(
            mesh,
            scalars=row,
            cmap="RdBu_r",
            clim=(-float(largest), float(largest)),
            smooth_shading=True,
            split_sharp_edges=True,
            feature_angle=_SHARP,
            show_scalar_bar=False,
            ambient=_AMBIENT,
            diffuse=1 - _AMBIENT,
            copy_mesh=True,
        )
        plotter.enable_parallel_projection()
        distance = 10 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        plotter.camera.focal_point = center
        plotter.camera.position = center + distance * eye
        plotter.camera.up = _UP
        plotter.camera.parallel_scale = size[1] / (2 * scale)
        plotter.reset_camera_clipping_range()
        pictures.append(plotter.screenshot(return_img=True))
        plotter.close()
    return np.stack(pictures)


if __name__ == "__main__":
    main(*sys.argv[1:])
