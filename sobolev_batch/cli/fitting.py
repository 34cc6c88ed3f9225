"""The command that moves a mesh nearer to another: fit."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import click
import numpy as np

from sobolev_batch.cli.group import cli
from sobolev_batch.fitting.closeness import Closeness
from sobolev_batch.fitting.fit import fit
from sobolev_batch.fitting.optimisation.stages import DEFAULT_ORDER, DEFAULT_SMOOTHING, DEFAULT_STEPS, FitProgress
from sobolev_batch.fitting.refine import refine
from sobolev_batch.surfaces.formats.readers import read_mesh
from sobolev_batch.surfaces.formats.writers import require_writable_format, write_mesh
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.similarity import Similarity


@cli.command("fit")
@click.argument("start", type=click.Path(path_type=Path))
@click.argument("target", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="File to write, .ply, .obj, .off or .stl.",
)
@click.option(
    "--order", type=float, default=DEFAULT_ORDER, show_default=True, help="Sobolev order of the distance to lower."
)
@click.option("--steps", type=int, default=DEFAULT_STEPS, show_default=True, help="Largest number of steps.")
@click.option(
    "--smoothing",
    type=float,
    default=DEFAULT_SMOOTHING,
    show_default=True,
    help="Smoothness of steps; more keeps triangles and worst points better, and the distance falls less.",
)
@click.option(
    *("--refine-to", "triangles"),
    type=int,
    metavar="TRIANGLES",
    help="Split edges too, where that lowers the distance most, until there are so many triangles.",
)
@click.option("--keep-boundary", is_flag=True, help="Leave vertices of open boundaries where they are.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit; otherwise TARGET is scaled to the unit sphere.")
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
    best mesh so far.
    """
    require_writable_format(output)
    own, goal = read_mesh(start), read_mesh(target)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(goal)
    method = fit if triangles is None else partial(refine, triangles=triangles)
    with _Steps() as shown:
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
    write_mesh(Mesh(vertices, fitted.mesh.triangles), output)
    click.echo(f"{len(fitted.mesh.triangles):,} triangles; {fitted.steps} steps; {fitted.end}")
    click.echo(f"before: {_text(fitted.before, similarity.scale)}")
    click.echo(f"after:  {_text(fitted.after, similarity.scale)}")
    for remark in fitted.remarks:
        click.echo(f"note: {remark}")


class _Steps:
    """Shows the steps of a fit on a terminal."""

    def __init__(self) -> None:
        self._bar: Any = click.progressbar(length=1, label="steps", file=sys.stderr) if sys.stderr.isatty() else None

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
        if self._bar is not None:
            self._bar.length = progress.steps
            # Earlier rounds may have needed fewer steps than they had.
            self._bar.update(progress.step - self._bar.pos)


def _text(closeness: Closeness, scale: float) -> str:
    """Return the numbers on one line, lengths in the files' unit."""
    parts = [f"distance {closeness.distance:.4e} ± {closeness.error:.0e}"]
    if np.isfinite(closeness.hausdorff):
        parts.append(f"Hausdorff at least {closeness.hausdorff / scale:.3g}")
        parts.append(f"Chamfer {closeness.chamfer / scale:.3g}")
    return ", ".join([*parts, f"smallest angle {closeness.smallest_angle:.3g} degrees"])
