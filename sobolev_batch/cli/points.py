"""The options of commands that read files of points, and what they read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from sobolev_batch.surfaces.shapes.mesh import Mesh
    from sobolev_batch.surfaces.shapes.point_cloud import PointCloud

    Pair = tuple[Mesh | PointCloud, Mesh | PointCloud]

Command = TypeVar("Command", bound=Callable[..., Any])


def point_options(command: Command) -> Command:
    """Add the options --weight and --area to a command."""
    weight = click.option(
        "--weight",
        metavar="COLUMN",
        help="Read files without triangles as points. Their areas are in this property, or in the column of this name "
        "or number.",
    )
    area = click.option(
        "--area", type=float, help="Read files without triangles as points that share this total area equally."
    )
    return weight(area(command))


def read_pair(a: Path, b: Path, weight: str | None, area: float | None) -> Pair:
    """Read two files: meshes, or points by the options of `point_options`.

    Raises:
        click.UsageError: There are points and neither option, an option and no points, or both options.
        MeshError: A file cannot be read.
    """
    from sobolev_batch.surfaces.formats.readers import read_mesh
    from sobolev_batch.surfaces.point_files import holds_points, read_points

    if weight is not None and area is not None:
        raise click.UsageError("both --weight and --area are given; give one of them")
    of_points = [path for path in (a, b) if holds_points(path)]
    is_given = weight is not None or area is not None
    if of_points and not is_given:
        raise click.UsageError(
            f"{of_points[0]} holds points and no triangles; give the area of each by --weight, or that of all by --area"
        )
    column = int(weight) if weight is not None and weight.isdecimal() else weight

    def read(path: Path) -> Mesh | PointCloud:
        return read_points(path, weight=column, area=area) if path in of_points else read_mesh(path)

    pair = read(a), read(b)
    # Not before: a file that cannot be read has no triangles either.
    if is_given and not of_points:
        raise click.UsageError("--weight and --area are for files of points, and both files have triangles")
    return pair


def require_mesh(option: str, pair: Pair) -> None:
    """Refuse an option that takes at least one mesh where there are points alone.

    Raises:
        click.UsageError: Neither is a mesh.
    """
    from sobolev_batch.surfaces.shapes.mesh import Mesh

    if not any(isinstance(surface, Mesh) for surface in pair):
        raise click.UsageError(f"{option} takes at least one mesh; leave it out for points alone")


def two_meshes(option: str, pair: Pair) -> tuple[Mesh, Mesh]:
    """Return a pair of meshes, for an option that takes no points.

    Raises:
        click.UsageError: There are points in it.
    """
    from sobolev_batch.surfaces.shapes.mesh import Mesh

    match pair:
        case (Mesh() as first, Mesh() as second):
            return first, second
    raise click.UsageError(f"{option} takes two meshes; leave it out for points")
