"""What a Fourier field knows of its surface: a ball and an egg are fitted to it.

``python -m benchmarks.reconstruction FILE ... --pictures FOLDER`` does the same with own meshes, and draws each fit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import sobolev_batch as sb
from benchmarks.table import Row, as_seconds, format_table
from benchmarks.timing import Effort, elapsed_seconds
from sobolev_batch.extras.figures.views import MeshView, draw_mesh

_MEASURED_AT = (-2.0, -4.0)
# Steps of the fits that are drawn.
_STAGES = (5, 20, 60, 150)
# Of pictures, which are seen from the front and above.
_RIGHT = np.array([1.4, 1.25, 0.0]) / np.hypot(1.4, 1.25)


@dataclass(frozen=True)
class Reconstruction:
    """A fit to the field of a target.

    Attributes:
        what: target and start, in words.
        target: makes the mesh whose field is known.
        start: makes the mesh that is fitted.
        orders: of the fits.
    """

    what: str
    target: Callable[[], sb.Mesh]
    start: Callable[[], sb.Mesh]
    orders: tuple[float, ...] = (-2.0,)

    def stages(self, order: float, steps: Sequence[int], effort: Effort) -> list[sb.fitting.Fit]:
        """The fits with each of these numbers of steps."""
        lattice = sb.Lattice(4.0, 24) if effort.quick else sb.Lattice(8.0, 96)
        field = sb.fourier_transform(self.target(), lattice)
        return [sb.fit(self.start(), field, order, steps=some) for some in steps]


def reconstructions(effort: Effort) -> Iterator[Row]:
    """Item 12: fits of a ball and an egg to fields of a head with two ears, of a thin ellipsoid and of a torus."""
    ball, egg = partial(_ball, effort), partial(_egg, effort)
    ears = partial(head_with_ears, 3 if effort.quick else 6)
    targets = (
        Reconstruction("a head with two ears, from a ball", ears, ball, (-2.0,) if effort.quick else (-4, -3, -2, -1)),
        Reconstruction("a head with two ears, from an egg", ears, egg),
        Reconstruction("an ellipsoid with a semi-axis of 0.03, from a ball", partial(_thin, effort), ball),
        Reconstruction("a torus, from a ball", lambda: sb.shapes.Torus(0.7, 0.3).mesh(96, 48), ball),
    )
    for reconstruction in targets[: 1 if effort.quick else None]:
        for order in reconstruction.orders:
            yield from _rows(reconstruction, order, effort)


def head_with_ears(level: int) -> sb.Mesh:
    """A ball with two ears, a nose and a tail, in the unit ball; its triangles are those of an icosphere."""
    ball = sb.shapes.icosphere(level)
    bumps = (
        (0.55, 40.0, (0.35, 0.25, 1.0)),
        (0.55, 40.0, (0.35, -0.25, 1.0)),
        (0.3, 8.0, (1.0, 0.0, 0.5)),
        (0.15, 60.0, (-1.0, 0.0, -0.2)),
    )
    radii = 0.55 + sum(
        height * np.exp(-sharpness * (1 - ball.vertices @ (np.array(place) / np.linalg.norm(place))))
        for height, sharpness, place in bumps
    )
    head = sb.Mesh(ball.vertices * np.asarray(radii)[:, None], ball.triangles)
    return sb.shapes.Similarity.to_unit_ball(head).apply(head)


def _ball(effort: Effort) -> sb.Mesh:
    ball = sb.shapes.icosphere(2 if effort.quick else 4)
    return ball.moved(0.6, (0.0, 0.0, 0.0))


def _egg(effort: Effort) -> sb.Mesh:
    return sb.shapes.Ellipsoid((0.9, 0.6, 0.6)).mesh(2 if effort.quick else 4)


def _thin(effort: Effort) -> sb.Mesh:
    return sb.shapes.Ellipsoid((1.0, 1.0, 0.03)).mesh(3 if effort.quick else 6)


def _rows(reconstruction: Reconstruction, order: float, effort: Effort) -> Iterator[Row]:
    found: list[sb.fitting.Fit] = []
    steps = [5 if effort.quick else _STAGES[-1]]
    seconds = elapsed_seconds(lambda: found.extend(reconstruction.stages(order, steps, effort)))
    (fit,), target, start = found, reconstruction.target(), reconstruction.start()
    what = f"{reconstruction.what}, fitted at order {order:g}"
    for measured in _MEASURED_AT:
        norm = sb.norm(target, measured, rtol=0.05)["norm"].item()
        before, after = (
            sb.distance(mesh, target, measured, rtol=0.05)["distance"].item() / norm for mesh in (start, fit.mesh)
        )
        text = f"{what}: relative distance at order {measured:g}, against the start"
        yield Row("12", text, f"{after:.3g}", f"{before:.3g}", after / before)
    near, far = sb.proximity(fit.mesh, target), sb.proximity(start, target)
    for name, after, before in (
        ("Hausdorff", near["hausdorff"], far["hausdorff"]),
        ("Chamfer", near["chamfer"], far["chamfer"]),
    ):
        yield Row("12", f"{what}: {name} distance, against the start", f"{after:.3g}", f"{before:.3g}", after / before)
    angle, even = fit.after.smallest_angle, fit.before.smallest_angle
    yield Row("12", f"{what}: smallest angle in degrees", f"{angle:.3g}", f"{even:.3g}", angle / even)
    yield Row("12", f"{what}: seconds, {fit.steps} steps", as_seconds(seconds))


def main() -> None:
    """Fit a ball and an egg to meshes in files, print a table and draw stages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reconstruction", description=__doc__)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="meshes; a head with two ears without any")
    parser.add_argument("--orders", nargs="+", type=float, default=[-4.0, -2.0], metavar="S", help="[-4 -2]")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each fit there, stage by stage")
    parser.add_argument("--up", choices=["x", "y", "z"], default="z", help="axis of the meshes that points up [z]")
    parser.add_argument("--quick", action="store_true", help="small sizes that only show that everything works")
    options = parser.parse_args()
    effort = Effort(1, options.quick, large=False)
    targets = {path.stem: partial(unit_mesh, path) for path in options.files} or {
        "ears": partial(head_with_ears, 3 if effort.quick else 6)
    }
    rows: list[Row] = []
    for name, target in targets.items():
        for start_name, start in (("ball", partial(_ball, effort)), ("egg", partial(_egg, effort))):
            reconstruction = Reconstruction(f"{name}, start: {start_name}", target, start)
            for order in options.orders:
                if options.pictures:
                    path = options.pictures / f"{name}-{start_name}{order:g}.png"
                    _draw(reconstruction, order, effort, path, options.up)
                for row in _rows(reconstruction, order, effort):
                    print("  ".join(filter(None, row.cells())), file=sys.stderr, flush=True)
                    rows.append(row)
    print(format_table(rows))


def unit_mesh(path: Path) -> sb.Mesh:
    """The mesh of a file, moved into the unit ball."""
    mesh = sb.read_mesh(path)
    return sb.shapes.Similarity.to_unit_ball(mesh).apply(mesh)


def _draw(reconstruction: Reconstruction, order: float, effort: Effort, path: Path, up: str) -> None:
    steps = _STAGES[:1] if effort.quick else _STAGES
    fits = zip(steps, reconstruction.stages(order, steps, effort), strict=True)
    meshes = {f"{some} steps": fit.mesh for some, fit in fits}
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_row({"start": reconstruction.start(), **meshes, "target": reconstruction.target()}, path, up)


def reconstructed(target: sb.Mesh, order: float, steps: int) -> sb.Mesh:
    """A ball that was fitted to the field of a target."""
    effort = Effort(1, quick=False, large=False)
    (fit,) = Reconstruction("", lambda: target, partial(_ball, effort)).stages(order, [steps], effort)
    return fit.mesh


def draw_row(meshes: Mapping[str, sb.Mesh], path: Path, up: str) -> None:
    """Draw meshes of the unit ball, by name, beside each other."""
    figure = Figure(figsize=(2.5 * len(meshes), 3.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.85))
    axes.margins(0.01)
    draw_mesh(axes, _row(list(meshes.values()), up))
    for i, (name, mesh) in enumerate(meshes.items()):
        place = ((i + 0.5) / len(meshes), 1.0)
        text = f"{name}\n{len(mesh.triangles):,} triangles"
        axes.annotate(text, place, xycoords="axes fraction", ha="center", va="bottom", fontsize=9)
    figure.savefig(path, dpi=110)


def _row(meshes: Sequence[sb.Mesh], up: str) -> MeshView:
    """Meshes of the unit ball side by side, all grey: their witness function is given as zero."""
    places = [2.1 * i * _RIGHT for i in range(len(meshes))]
    # A cyclic permutation of the axes mirrors nothing.
    upright = [np.roll(mesh.vertices, "zyx".index(up), axis=1) for mesh in meshes]
    vertices = np.concatenate([points + place for points, place in zip(upright, places, strict=True)])
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = np.concatenate(
        [mesh.triangles + number for mesh, number in zip(meshes, before[:-1], strict=True)], dtype=np.int32
    )
    return MeshView("", vertices, triangles, np.zeros((1, len(vertices))), (-2.0,), len(triangles))


if __name__ == "__main__":
    main()
