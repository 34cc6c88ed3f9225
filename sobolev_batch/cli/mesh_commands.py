"""Commands on mesh files: compare, with a verdict as exit status where asked, fit, and info."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from sobolev_batch.cli.common import (
    EXIT_DIFFERENT,
    EXIT_UNDECIDED,
    PATH,
    below_option,
    best_effort_option,
    cli,
    echo,
    echo_json,
    echo_lines,
    json_option,
    memory_size,
    orders_option,
    progress_bar,
)
from sobolev_batch.cli.interruption import Deadline
from sobolev_batch.errors import InputError, MeshError
from sobolev_batch.extras.fitting import DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.visible import FILE_UNITS, visible

if TYPE_CHECKING:
    import xarray as xr

    from sobolev_batch.arrays import Reals
    from sobolev_batch.extras.fitting.fit import FitProgress, FitQuality
    from sobolev_batch.geometry.mesh import Mesh
    from sobolev_batch.geometry.surface import Similarity

_STATUSES = {"same": 0, "different": EXIT_DIFFERENT, "undecided": EXIT_UNDECIDED}
# Options of compare that a verdict knows; it chooses the accuracy of the distance itself.
_KNOWN = {"a", "b", "below", "orders", "memory", "no_scaling", "style"}

# A radius beyond it, or below its inverse, is far from the unit of length.
_FAR_UNIT = 10.0
# Default of compare, which then takes the nearest attainable accuracy.
_DEFAULT_RTOL = 1e-2
# In radii of the target; distances have about as many digits.
_MOST_ROUNDING = 1e-6


@cli.command("compare")
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@orders_option("Print the distance of this order, which may be any below -1/2.", f"{DEFAULT_ORDER:g}")
@click.option(
    "--rtol", type=float, help="Reach this relative error at most. [default: 1e-2, or the nearest attainable]"
)
@click.option(
    "--memory", type=memory_size, metavar="SIZE", help="Limit the memory of a transform for --rtol. [default: 2GB]"
)
@best_effort_option
@click.option(
    "--xi-max",
    type=float,
    help="Sample frequencies up to this one on each axis, in place of --rtol. [default: 5 with --M]",
)
@click.option(
    "--M",
    "intervals",
    type=int,
    metavar="M",
    help="Divide each axis of the lattice into M intervals, in place of --rtol. [default: 64 with --xi-max]",
)
@click.option(
    "--yardsticks",
    "with_yardsticks",
    is_flag=True,
    help="Print which move, noise and decimation bring B as far from itself.",
)
@click.option(
    "--proximity",
    "with_proximity",
    is_flag=True,
    help="Also print Hausdorff, mean, RMS and other usual distances.",
)
@click.option(
    "--threshold", type=float, help="Take this length for the F-score of --proximity. [default: 1 % of the radius of B]"
)
@click.option("--align", "with_motion", is_flag=True, help="First move A rigidly to where it is nearest to B.")
@click.option("--unit", metavar="NAME", help="Name the unit of length of both files, such as mm.")
@click.option(
    "--witness",
    "witness_path",
    type=PATH,
    metavar="PATH",
    help="Write both meshes with the witness function of the first order at their vertices, for MeshLab, into "
    "PATH-a.ply and PATH-b.ply, or draw them if PATH ends in .png, .svg or .pdf. With --proximity also distances.",
)
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise B is scaled to the unit sphere.")
@below_option("Tell whether the distance is below FRACTION of the norm of B, such as 1e-3 or 0.1%, by the exit status.")
@json_option
@click.pass_context
def compare_command(
    context: click.Context,
    /,
    a: Path,
    b: Path,
    orders: tuple[float, ...],
    xi_max: float | None,
    intervals: int | None,
    with_yardsticks: bool,
    with_proximity: bool,
    threshold: float | None,
    with_motion: bool,
    unit: str | None,
    witness_path: Path | None,
    no_scaling: bool,
    below: float | None,
    style: str,
    **accuracy: Any,
) -> None:
    """Print how much two meshes differ.

    B is the reference. The difference is given in per cent of its norm, with a bound on the error, and with the share
    of the squared distance that a change of area explains. With --below, print one line on whether both are the same
    surface. The exit status is then 0 if they are, 1 if they are not, 4 if that cannot be told, and 2 after any error.
    """
    from sobolev_batch.extras.fitting.align import align, moved_by
    from sobolev_batch.geometry.formats.readers import read_mesh
    from sobolev_batch.geometry.proximity import proximity
    from sobolev_batch.geometry.surface import Similarity, placement_doubt
    from sobolev_batch.norms.columns import parts_as_variables
    from sobolev_batch.norms.distances import distance, yardsticks
    from sobolev_batch.tables.text import percent
    from sobolev_batch.testing.verdict import require_place, write_difference
    from sobolev_batch.transform.lattice import Lattice

    if below is not None:
        context.exit(_judge_files(context, a, b, below))
    if xi_max is not None or intervals is not None:
        if accuracy["rtol"] is not None:
            raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")
        accuracy["lattice"] = Lattice(5.0 if xi_max is None else xi_max, 64 if intervals is None else intervals)
    elif accuracy["rtol"] is None:
        accuracy |= {"rtol": _DEFAULT_RTOL, "best_effort": True}
    first, second = read_mesh(a), read_mesh(b)
    if witness_path is not None:
        require_place(witness_path)
    orders = orders or (DEFAULT_ORDER,)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(second)
    motion = before = None
    if with_motion:
        before = distance(similarity.apply(first), similarity.apply(second), orders[0], **accuracy)
        motion = align(first, second, order=orders[0])
        first = moved_by(first, motion)
    pair = similarity.apply(first), similarity.apply(second)
    doubt = placement_doubt(*(surface.extent for surface in pair))
    radius = second.bounding_sphere[1]
    for line in _remarks({a.name: first, b.name: second}, doubt, radius if no_scaling else 1.0, unit):
        echo(f"note: {line}", err=True)
    # Bad settings are refused before a long computation.
    nearness = proximity(first, second, threshold=threshold) if with_proximity else None
    results = yardsticks(*pair, orders, **accuracy) if with_yardsticks else distance(*pair, orders, **accuracy)
    area_change = first.area / second.area - 1
    length = unit or FILE_UNITS
    files: dict[str, Any] = {"scaling": not no_scaling, "names": (a.name, b.name)}
    files |= {"distances": length} if with_proximity else {}
    if style == "json":
        if witness_path is not None:
            write_difference(first, second, witness_path, orders[0], **files)
        rows = parts_as_variables(results).to_dataframe().reset_index().to_dict(orient="records")
        defects = {"a": first.defects, "b": second.defects}
        more = {
            "motion": None if motion is None else motion.tolist(),
            "before": None if before is None else before["relative"].item(),
        }
        more |= {"settings": results.attrs, "proximity": nearness, "doubt": doubt, "defects": defects, "unit": unit}
        echo_json({"a": a, "b": b, "area_change": area_change, **vars(similarity), "orders": rows, **more})
        return
    if motion is not None and before is not None:
        echo(f"where it is in the file: {percent(before['relative'].item(), before['relative_error'].item())}")
        echo(_motion_text(motion))
    _print_answers(a.name, b.name, results, area_change, accuracy["rtol"])
    echo(
        f"distances of orders are in {length}; the radius of {visible(b.name)} is {radius:.6g}"
        if no_scaling
        else f"distances of orders are in radii of {visible(b.name)}, {radius:.6g} {length} each "
        f"(scale {similarity.scale:.6g}, origin {' '.join(f'{x:.6g}' for x in similarity.origin)})"
    )
    if nearness is not None:
        _print_proximity(nearness, (first, second), length)
    if witness_path is not None:
        echo(write_difference(first, second, witness_path, orders[0], **files))


def _motion_text(motion: Reals) -> str:
    """Return a rigid motion (4, 4) in words, with its numbers."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec(degrees=True)
    angle = math.hypot(*vector)
    # What rounding makes of zero would be read as a motion.
    moved = np.where(np.abs(motion[:3, 3]) < 1e-9 * np.abs(motion[:3, 3]).max(), 0.0, motion[:3, 3])
    axis, shift = (" ".join(f"{x:.6g}" for x in numbers) for numbers in (vector / (angle or 1.0), moved))
    if angle < 1e-9:
        return f"moved: shifted by ({shift})"
    return f"moved: rotated by {angle:.6g} degrees around ({axis}) through the origin, then shifted by ({shift})"


def _remarks(meshes: Mapping[str, Mesh], doubt: str | None, size: float, unit: str | None) -> Iterator[str]:
    """Yield what may make one doubt a comparison: defects of meshes, their places, and a unit far from their size."""
    yield from (f"{name}: {', '.join(mesh.defects)}" for name, mesh in meshes.items() if mesh.defects)
    first = next(iter(meshes))
    if doubt is not None:
        yield f"{first}: {doubt}"
    if not 1 / _FAR_UNIT < size < _FAR_UNIT:
        yield (
            f"without scaling, wavelengths above 1 {unit or 'file unit'} weigh alike and shorter ones less, "
            f"and the reference has a radius of {size:.4g}; leave out --no-scaling to weigh them against it"
        )


def _print_proximity(found: Mapping[str, float], meshes: tuple[Mesh, Mesh], unit: str) -> None:
    """Print the usual distances in both directions, what is made of them, and the shapes of both meshes."""
    from sobolev_batch.tables.text import printed_table, with_error

    names = {"hausdorff": "Hausdorff, at least", "mean": "mean", "rms": "RMS", "p50": "50 % within"}
    names |= {
        "p95": "95 % within",
        "p99": "99 % within",
        "normal_mean": "normals, mean",
        "normal_max": "normals, largest",
    }
    rows = []
    for name, title in names.items():
        ending = " deg" if name.startswith("normal") else ""
        rows.append([title, *(f"{found[f'{name}{way}']:.4g}{ending}" for way in ("_forward", "_backward", ""))])
    echo_lines(printed_table(rows, [f"in {unit}", "A to B", "B to A", "larger"], "text"))
    echo(f"Chamfer, the sum of both means: {with_error(found['chamfer'], found['chamfer_error'])} (s.e.)")
    echo(
        f"F-score at {found['threshold']:.4g}: {100 * found['fscore']:.4g} % "
        f"({100 * found['precision']:.4g} % of A, {100 * found['recall']:.4g} % of B)"
    )
    for label, mesh in zip("AB", meshes, strict=True):
        volume = "not closed" if math.isnan(mesh.volume) else f"volume {mesh.volume:.6g}"
        angle, ratio = mesh.smallest_angles.min(), mesh.aspect_ratios.max()
        echo(
            f"{label}: {volume}, area {mesh.area:.6g}, smallest angle {angle:.3g} deg, aspect ratio at most {ratio:.3g}"
        )


def _print_answers(name: str, reference: str, results: xr.Dataset, area_change: float, rtol: float | None) -> None:
    """Print a sentence for each order, what is as far away if that was measured, and then the numbers."""
    from sobolev_batch.tables.text import answer, likeness

    by_order = [results.sel(order=order) for order in results["order"].values]
    for sentence in dict.fromkeys(answer(name, reference, result, area_change) for result in by_order):
        echo(sentence)
    # Of equal meshes there is no more to tell.
    unequal = [result for result in by_order if result["distance"] > 0]
    for result in unequal if "moved" in results else ():
        echo_lines(likeness(visible(name), visible(reference), result))
    for result in unequal:
        echo(_details(result, rtol))
    if rtol is not None and "M" in results.attrs:
        echo(_settings_text(results.attrs))


def _details(result: xr.Dataset, rtol: float | None) -> str:
    """Return the distance of one order and the parts of its error, on one line."""
    from sobolev_batch.tables.text import with_error

    by_part = result["error_part"].to_series()
    parts = ", ".join(f"{name} {part:.0e}" for name, part in by_part.items() if name != "statistical" or part > 0)
    remark = "" if rtol is None or result["within"].item() else f", more than rtol {rtol:g}"
    distance_text = with_error(result["distance"].item(), result["error"].item())
    return f"order {result['order'].item():g}: distance {distance_text} ({parts}){remark}"


def _settings_text(attributes: Mapping[str, Any]) -> str:
    """Return what was chosen for an accuracy, on one line."""
    text = f"xi_max {attributes['xi_max']:.4g}, M {attributes['M']}, {attributes['dtype']}"
    if attributes["octaves"]:
        octaves = f"{attributes['octaves']} octave{'s' * (attributes['octaves'] != 1)}"
        text += f", {octaves} up to {attributes['highest_frequency']:.4g}"
    return f"{text}, seed {attributes['seed']}"


def _judge_files(context: click.Context, a: Path, b: Path, below: float) -> int:
    """Print one line on whether two files hold the same surface, and return the exit status."""
    from sobolev_batch.testing.verdict import same_surface

    given = {
        parameter.opts[0]
        for parameter in context.command.params
        if context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE
        and parameter.name not in _KNOWN
    }
    if given:
        raise click.UsageError(f"--below gives a verdict and no numbers; leave out {', '.join(sorted(given))}")
    if not 0 < below < 1:
        raise click.UsageError(f"--below takes a fraction between 0 and 1, or 0 and 100 %, found {below:g}")
    orders = context.params["orders"] or (DEFAULT_ORDER,)
    if len(orders) > 1:
        raise click.UsageError("--below takes one --order")
    (order,) = orders
    settings = {"scaling": not context.params["no_scaling"], "memory": context.params["memory"]}
    verdict = same_surface(a, b, tolerance=below, order=order, **settings)
    if context.params["style"] == "json":
        echo_json(verdict, a=a, b=b, distance=verdict.distance, error=verdict.error)
    else:
        echo(f"{a.name}: {verdict}")
    return _STATUSES[verdict.outcome]


@cli.command("fit", short_help="Move the vertices of START to bring it nearer to TARGET.")
@click.argument("start", type=PATH)
@click.argument("target", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Write the mesh to this file, .ply, .obj, .off or .stl.")
@click.option("--order", type=float, default=DEFAULT_ORDER, show_default=True, help="Lower the distance of this order.")
@click.option("--steps", type=int, default=DEFAULT_STEPS, metavar="N", show_default=True, help="Take N steps at most.")
@click.option(
    "--smoothing",
    type=float,
    default=DEFAULT_SMOOTHING,
    show_default=True,
    help="Smooth the steps: more keeps triangles better, less lowers the distance more. A far START takes at least 4.",
)
@click.option(
    *("--refine-to", "triangles"),
    type=int,
    metavar="N",
    help="Also split the edges that lower the distance most, until there are N triangles.",
)
@click.option("--keep-boundary", is_flag=True, help="Leave vertices of open boundaries where they are.")
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise TARGET is scaled to the unit sphere.")
def fit_command(
    start: Path,
    target: Path,
    output: Path,
    triangles: int | None,
    no_scaling: bool,
    **settings: Any,
) -> None:
    """Move the vertices of START to bring it nearer to TARGET, and write the mesh.

    Both are mesh files in the same unit. The triangles stay as they are, unless you refine them. Ctrl-C ends with the
    best mesh so far, and so does SIGTERM.
    """
    import numpy as np

    from sobolev_batch.extras.fitting.fit import fit, refine
    from sobolev_batch.extras.fitting.objective import require_comparable
    from sobolev_batch.geometry.formats.readers import read_mesh, require_writable, write_mesh
    from sobolev_batch.geometry.mesh import Mesh
    from sobolev_batch.geometry.surface import Similarity

    require_writable(output)
    if output.exists() and output.samefile(target):
        raise InputError(f"{output}: this is the target, which would be lost; name another file")
    own, goal = read_mesh(start), read_mesh(target)
    # Refused in the files' own unit.
    require_comparable(own, goal)
    similarity = Similarity() if no_scaling else Similarity.to_unit_ball(goal)
    method = fit if triangles is None else partial(refine, triangles=triangles)
    has_begun = Event()
    bar = progress_bar(1, "steps", show_count=False) if sys.stderr.isatty() else None

    def show(progress: FitProgress) -> None:
        has_begun.set()
        if bar is not None:
            bar.length = progress.steps
            # Earlier rounds may have needed fewer steps than they had.
            bar.update(progress.step - bar.pos)

    with bar or nullcontext(), Deadline.with_results(has_begun.is_set):
        fitted = method(similarity.apply(own), similarity.apply(goal), **settings, notify=show)
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

    from sobolev_batch.geometry.formats.readers import read_mesh

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


def _text(quality: FitQuality, scale: float) -> str:
    """Return the numbers on one line, lengths in the files' unit."""
    from sobolev_batch.tables.text import percent, with_error

    if not math.isfinite(quality.distance):
        return "not measured"
    relative = percent(quality.relative, quality.relative_error)
    parts = [f"differs by {relative}, distance {with_error(quality.distance, quality.error)}"]
    if math.isfinite(quality.hausdorff):
        parts.append(f"Hausdorff ≥ {quality.hausdorff / scale:.3g}")
        parts.append(f"Chamfer {quality.chamfer / scale:.3g}")
    return ", ".join([*parts, f"smallest angle {quality.smallest_angle:.3g} degrees"])


@cli.command("info")
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE...")
@json_option
def info_command(files: tuple[Path, ...], style: str) -> None:
    """Print what mesh files hold: counts, size, and what is unusual.

    Lengths are in the unit of each file. Edges of one triangle are open. The aspect ratio of an equilateral triangle
    is 1.
    """
    from sobolev_batch.geometry.formats.readers import read_mesh

    facts = [_facts(path, read_mesh(path)) for path in files]
    if style == "json":
        echo_json({"files": facts})
    for one in facts if style == "text" else ():
        box = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in zip("xyz", *one["box"], strict=True))
        volume = "none: it is not closed" if math.isnan(one["volume"]) else f"{one['volume']:.6g}"
        echo(f"{one['file']}: {one['triangles']:,} triangles, {one['vertices']:,} vertices")
        echo(f"  area {one['area']:.6g}, volume {volume}")
        echo(f"  box {box}")
        echo(
            f"  smallest angle {one['smallest_angle']:.3g}° (median {one['smallest_angle_median']:.3g}°), "
            f"aspect ratio up to {one['aspect_ratio']:.3g} (median {one['aspect_ratio_median']:.3g})"
        )
        echo(f"  {'; '.join(one['defects']) or 'closed, all triangles face outwards'}")


def _facts(path: Path, mesh: Mesh) -> dict[str, Any]:
    """Return what is known of a mesh by itself, lengths in its own unit."""
    import numpy as np

    angles, ratios = mesh.smallest_angles, mesh.aspect_ratios
    return {
        "file": path,
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "area": mesh.area,
        "volume": mesh.volume,
        "box": [end.tolist() for end in mesh.extent.box],
        "smallest_angle": float(angles.min()),
        "smallest_angle_median": float(np.median(angles)),
        "aspect_ratio": float(ratios.max()),
        "aspect_ratio_median": float(np.median(ratios)),
        **mesh.counts,
        "defects": mesh.defects,
    }
