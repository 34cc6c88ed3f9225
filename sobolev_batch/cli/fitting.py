"""The command that moves a mesh nearer to another: fit."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import click

from sobolev_batch.cli.group import cli
from sobolev_batch.cli.interruption import Deadline
from sobolev_batch.cli.output import echo, progress_bar
from sobolev_batch.errors import InputError, MeshError
from sobolev_batch.fitting import DEFAULT_ORDER, DEFAULT_SMOOTHING, DEFAULT_STEPS

if TYPE_CHECKING:
    from sobolev_batch.fitting.fit import FitProgress, FitQuality
    from sobolev_batch.surfaces.shapes.mesh import Mesh
    from sobolev_batch.surfaces.shapes.similarity import Similarity

# In radii of the target; distances have about as many digits.
_MOST_ROUNDING = 1e-6


@cli.command("fit", short_help="Move the vertices of START to bring it nearer to TARGET.")
@click.argument("start", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="Write the mesh to this file, .ply, .obj, .off or .stl.",
)
@click.option("--order", type=float, default=DEFAULT_ORDER, show_default=True, help="Lower the distance of this order.")
@click.option("--steps", type=int, default=DEFAULT_STEPS, show_default=True, help="Take so many steps at most.")
@click.option(
    "--smoothing",
    type=float,
    default=DEFAULT_SMOOTHING,
    show_default=True,
    help="Make steps so smooth. Smoother ones keep triangles and worst points better, but lower the distance less. "
    "A far START takes at least 4.",
)
@click.option(
    *("--refine-to", "triangles"),
    type=int,
    metavar="TRIANGLES",
    help="Split edges, too, until there are so many triangles: those where that lowers the distance most.",
)
@click.option("--keep-boundary", is_flag=True, help="Leave vertices of open boundaries where they are.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise TARGET is scaled to the unit sphere.")
def fit_command(
    start: Path,
    target: Path,
    output: Path,
    order: float,
    steps: int,
    smoothing: float,
    triangles: int | None,
    keep_boundary: bool,
    no_scaling: bool,
) -> None:
    """Move the vertices of START to bring it nearer to TARGET, and write the mesh.

    Both are mesh files in the same unit. The triangles stay as they are, unless you refine them. Ctrl-C ends with the
    best mesh so far, and so does SIGTERM.
    """
    import numpy as np

    from sobolev_batch.fitting.fit import fit
    from sobolev_batch.fitting.problem import require_comparable
    from sobolev_batch.fitting.refine import refine
    from sobolev_batch.surfaces.formats.objects import require_writable, write_mesh
    from sobolev_batch.surfaces.formats.readers import read_mesh
    from sobolev_batch.surfaces.shapes.mesh import Mesh
    from sobolev_batch.surfaces.shapes.similarity import Similarity

    require_writable(output)
    if output.exists() and output.samefile(target):
        raise InputError(f"{output}: this is the target, which would be lost; name another file")
    own, goal = read_mesh(start), read_mesh(target)
    # Refused in the files' own unit.
    require_comparable(own, goal)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(goal)
    method = fit if triangles is None else partial(refine, triangles=triangles)
    with _Steps() as shown, Deadline.with_results(shown.has_begun):
        fitted = method(
            similarity.apply(own),
            similarity.apply(goal),
            order,
            steps=steps,
            smoothing=smoothing,
            keep_boundary=keep_boundary,
            notify=shown,
        )
    vertices = np.asarray(fitted.mesh.vertices) / similarity.scale + np.asarray(similarity.origin)
    result = Mesh(vertices, fitted.mesh.triangles)
    write_mesh(result, output)
    echo(f"{len(fitted.mesh.triangles):,} triangles; {fitted.steps} steps; {fitted.end}")
    echo(f"before: {_text(fitted.before, similarity.scale)}")
    echo(f"after:  {_text(fitted.after, similarity.scale)}")
    for remark in (*fitted.remarks, *_lost_digits(result, output, similarity)):
        echo(f"note: {remark}")


def _lost_digits(mesh: Mesh, path: Path, similarity: Similarity) -> Iterator[str]:
    """Yield a remark if the file of a mesh, or the mesh's own unit, lacks digits for its vertices."""
    import numpy as np

    from sobolev_batch.surfaces.formats.readers import read_mesh

    try:
        written = read_mesh(path)
    except MeshError as error:
        yield f"the file cannot be read back: {error}"
        return
    moved = float(np.finfo(np.float64).eps * np.abs(mesh.vertices).max())
    if len(written.triangles) == len(mesh.triangles):
        moved += float(np.abs(np.subtract(written.corners(), mesh.corners())).max())
    if similarity.scale * moved > _MOST_ROUNDING:
        yield (
            f"so far from the origin, numbers in {path.name} have too few digits: vertices are off by up to "
            f"{moved:.1g}, and the distance is not that of the file; move the meshes to the origin, or write a .ply"
        )


class _Steps:
    """Shows the steps of a fit on a terminal."""

    def __init__(self) -> None:
        self._has_begun = False
        self._bar: Any = progress_bar(1, "steps", show_count=False) if sys.stderr.isatty() else None

    def has_begun(self) -> bool:
        """Return whether a step has been taken."""
        return self._has_begun

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.__exit__(kind, error, trace)

    def __call__(self, progress: FitProgress) -> None:
        self._has_begun = True
        if self._bar is not None:
            self._bar.length = progress.steps
            # Earlier rounds may have needed fewer steps than they had.
            self._bar.update(progress.step - self._bar.pos)


def _text(quality: FitQuality, scale: float) -> str:
    """Return the numbers on one line, lengths in the files' unit."""
    from sobolev_batch.results.tables.formatting import percent, with_error

    if not math.isfinite(quality.distance):
        return "not measured"
    relative = percent(quality.relative, quality.relative_error)
    parts = [f"differs by {relative}, distance {with_error(quality.distance, quality.error)}"]
    if math.isfinite(quality.hausdorff):
        parts.append(f"Hausdorff ≥ {quality.hausdorff / scale:.3g}")
        parts.append(f"Chamfer {quality.chamfer / scale:.3g}")
    return ", ".join([*parts, f"smallest angle {quality.smallest_angle:.3g} degrees"])
