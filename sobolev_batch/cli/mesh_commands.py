"""Commands on mesh files: compare, with a verdict as exit status where asked, and info."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sobolev_batch.cli.options import PATH, below_option, json_option, memory_size, orders_option
from sobolev_batch.cli.output import echo, echo_result
from sobolev_batch.cli.program import ERROR_STATUS, EXIT_INPUT, cli
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.plugins import FEATURES, extra
from sobolev_batch.visible import FILE_UNITS, visible

if TYPE_CHECKING:
    import xarray as xr

    from sobolev_batch.arrays import Reals
    from sobolev_batch.geometry.deviation import Deviations
    from sobolev_batch.geometry.mesh import Mesh
    from sobolev_batch.geometry.surface import Similarity

# Exit statuses of a verdict; like diff, which has 1 for files that differ.
_STATUSES = {"same": 0, "within": 0, "different": 1, "not within": 1, "undecided": 4}
# Options that every verdict knows; those of one on a fraction of the norm, which chooses the accuracy of the distance
# itself; and those of one on a length.
_KNOWN = {"a", "b", "below", "within", "style"}
_KNOWN_OF_FRACTIONS, _KNOWN_OF_LENGTHS = {"orders", "memory", "no_scaling"}, {"unit"}

# A radius beyond it, or below its inverse, is far from the unit of length.
_FAR_UNIT = 10.0
# Default of compare, which then takes the nearest attainable accuracy.
_DEFAULT_RTOL = 1e-2
# A turn by less, in degrees, or a shift by less than this fraction of the largest one, is rounding.
_NO_MOTION = 1e-9
# Numbers of `proximity` that are printed in both directions.
_DISTANCES = {
    "mean": "mean",
    "rms": "RMS",
    "p50": "50 % within",
    "p95": "95 % within",
    "p99": "99 % within",
    "normal_mean": "normals, mean",
    "normal_max": "normals, largest",
}


@dataclass(frozen=True)
class _CompareOptions:
    """The arguments and options of compare, by the names of its parameters; None where one is not given."""

    a: Path
    b: Path
    orders: tuple[float, ...] | None
    rtol: float | None
    memory: int | None
    best_effort: bool
    xi_max: float | None
    intervals: int | None
    yardsticks: bool
    proximity: bool
    threshold: float | None
    align: bool
    unit: str | None
    witness: Path | None
    no_scaling: bool
    below: float | None
    within: str | None
    verbose: bool
    style: str

    def __post_init__(self) -> None:
        if self.below is not None or self.within is not None:
            self._check_verdict()
        elif self.has_lattice and self.rtol is not None:
            raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")

    def _check_verdict(self) -> None:
        if self.below is not None and self.within is not None:
            raise click.UsageError("--below and --within ask for one verdict each; leave out one of them")
        option, allowed = "--within" if self.below is None else "--below", self.allowed_fraction
        known = _KNOWN | (_KNOWN_OF_LENGTHS if allowed is None else _KNOWN_OF_FRACTIONS)
        context = click.get_current_context()
        given = [
            parameter.opts[0]
            for parameter in context.command.params
            if parameter.name not in known and getattr(self, str(parameter.name)) not in (None, False)
        ]
        if given:
            asked = f"{option} with a length" if allowed is None else option
            raise click.UsageError(f"{asked} gives a verdict and no numbers; leave out {', '.join(sorted(given))}")
        if allowed is not None and not 0 < allowed < 1:
            raise click.UsageError(f"{option} takes a fraction between 0 and 1, or 0 and 100 %, found {allowed:g}")
        if len(self.chosen_orders) > 1:
            raise click.UsageError(f"{option} takes one --order")

    @property
    def allowed_fraction(self) -> float | None:
        """The fraction of the norm of B that the distance may have for a verdict; None for one on a length, or none."""
        from sobolev_batch.parameters import fraction

        if self.within is None:
            return self.below
        return fraction(self.within) if self.within.rstrip().endswith("%") else None

    @property
    def chosen_orders(self) -> tuple[float, ...]:
        """The orders, by default one."""
        return self.orders or (DEFAULT_ORDER,)

    @property
    def has_lattice(self) -> bool:
        """True if the lattice is given, in place of an accuracy."""
        return self.xi_max is not None or self.intervals is not None

    @property
    def accuracy(self) -> dict[str, Any]:
        """The settings of `distance`."""
        from sobolev_batch.transform.lattice import Lattice

        settings = {"rtol": self.rtol, "memory": self.memory, "best_effort": self.best_effort}
        if self.has_lattice:
            xi_max = 5.0 if self.xi_max is None else self.xi_max
            return settings | {"lattice": Lattice(xi_max, 64 if self.intervals is None else self.intervals)}
        return settings if self.rtol is not None else settings | {"rtol": _DEFAULT_RTOL, "best_effort": True}


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
@click.option(
    "--best-effort",
    is_flag=True,
    help="Take the nearest attainable accuracy where the requested one is out of reach, and mark it.",
)
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
@click.option("--yardsticks", is_flag=True, help="Print which move, noise and decimation bring B as far from itself.")
@click.option(
    "--proximity", is_flag=True, help="Also print distances of points: the largest deviation, mean, RMS and others."
)
@click.option(
    "--threshold", type=float, help="Take this length for the F-score of --proximity. [default: 1 % of the radius of B]"
)
@click.option("--align", is_flag=True, help="First move A rigidly to where it is nearest to B.")
@click.option(
    "--unit",
    metavar="NAME",
    help="Name the unit of length of both files, such as mm. The first line is then the largest deviation.",
)
@click.option(
    "--witness",
    type=PATH,
    metavar="PATH",
    help="Write both meshes with the witness function of the first order at their vertices, for MeshLab, into "
    "PATH-a.ply and PATH-b.ply, or draw them if PATH ends in .png, .svg or .pdf. With --proximity also distances.",
)
@click.option("--no-scaling", is_flag=True, help="Keep the files' unit. Otherwise B is scaled to the unit sphere.")
@below_option("Tell whether the distance is below FRACTION of the norm of B, such as 1e-3 or 0.1%, by the exit status.")
@click.option(
    "--within",
    metavar="LENGTH",
    help="Tell by the exit status whether no point of either mesh is farther from the other one than LENGTH, such as "
    "0.1 in the files' unit, or 0.1mm with --unit. A percentage is that of --below.",
)
@click.option("--verbose", is_flag=True, help="Also print the parts of each error, and the settings that were chosen.")
@json_option
@click.pass_context
def compare_command(context: click.Context, /, **options: Any) -> None:
    """Print how much two meshes differ.

    B is the reference. The difference is given in per cent of its norm, with a bound on the error, with the share
    of the squared distance that a change of area explains, and with the move of B that takes it as far from itself.
    With --below, print one line on whether both are the same surface, and with --within, on whether they are as near
    everywhere as a length. The exit status is then 0 if they are, 1 if they are not, 4 if that cannot be told, and 2
    after any error.
    """
    if options["below"] is not None or options["within"] is not None:
        # The usual status of other errors says that the files differ.
        context.meta[ERROR_STATUS] = EXIT_INPUT
    chosen = _CompareOptions(**options)
    if chosen.allowed_fraction is not None:
        context.exit(_judge_files(chosen, chosen.allowed_fraction))
    if chosen.within is not None:
        context.exit(_judge_deviation_of_files(chosen, chosen.within))
    found = _Comparison.of_files(chosen)
    echo_result(chosen.style, "\n".join(map(visible, found.lines)), found.document)
    if chosen.witness is not None:
        where = found.write_witness(chosen.witness)
        if chosen.style == "text":
            echo(where)


def _judge_files(options: _CompareOptions, below: float) -> int:
    """Print one line on whether two files hold the same surface, and return the exit status."""
    from sobolev_batch.testing.verdict import same_surface

    (order,) = options.chosen_orders
    scaling = not options.no_scaling
    verdict = same_surface(options.a, options.b, tolerance=below, order=order, scaling=scaling, memory=options.memory)
    numbers = {"a": options.a, "b": options.b, "distance": verdict.distance, "error": verdict.error}
    echo_result(options.style, visible(f"{options.a.name}: {verdict}"), vars(verdict) | numbers)
    return _STATUSES[verdict.outcome]


def _judge_deviation_of_files(options: _CompareOptions, within: str) -> int:
    """Print one line on whether two files are as near everywhere as a length, and return the exit status."""
    from sobolev_batch.testing.within import judge_deviation

    verdict = judge_deviation(options.a, options.b, within, options.unit)
    answer: dict[str, Any] = {"a": options.a, "b": options.b, "outcome": verdict.outcome, "length": verdict.length}
    bounds = asdict(verdict.deviations.both) | asdict(verdict.deviations)
    answer |= {"unit": verdict.unit, "beyond": verdict.beyond}
    echo_result(options.style, visible(f"{options.a.name}: {verdict}"), answer | bounds)
    return _STATUSES[verdict.outcome]


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Two meshes of files, and how much they differ.

    Attributes:
        first: The mesh of A in the unit of the file, where it was moved to.
        second: That of B.
        similarity: From this unit to that of the distances.
        results: What `yardsticks` returns, of moves alone if no others were asked for.
        nearness: What `proximity` returns, in the unit of the files; None if not asked for.
        deviations: Largest deviations in this unit; None if it has no name and `proximity` was not asked for.
        motion: Rigid motion (4, 4) of A, and the distance before; None if not asked for.
        doubt: Question whether both are in one unit and place; None where they look it.
    """

    options: _CompareOptions
    first: Mesh
    second: Mesh
    similarity: Similarity
    results: xr.Dataset
    nearness: dict[str, float] | None
    deviations: Deviations | None
    motion: tuple[Reals, xr.Dataset] | None
    doubt: str | None

    @classmethod
    def of_files(cls, options: _CompareOptions) -> _Comparison:
        """Read and compare two files; what may make one doubt the result is printed as a note."""
        from sobolev_batch.geometry.deviation import largest_deviation
        from sobolev_batch.geometry.formats.readers import read_mesh
        from sobolev_batch.geometry.proximity import proximity_and_deviations
        from sobolev_batch.geometry.surface import Similarity, placement_doubt
        from sobolev_batch.norms.distances import distance
        from sobolev_batch.norms.yardsticks import CHANGES, yardsticks
        from sobolev_batch.testing.difference import require_place

        accuracy = options.accuracy
        first, second = read_mesh(options.a), read_mesh(options.b)
        if options.witness is not None:
            require_place(options.witness)
        similarity = Similarity() if options.no_scaling else Similarity.to_unit_ball(second)
        orders, motion = options.chosen_orders, None
        if options.align:
            align = extra(FEATURES, "align", "--align")
            before = distance(similarity.apply(first), similarity.apply(second), orders[0], **accuracy)
            motion = align(first, second, order=orders[0]), before
            first = _moved(first, motion[0])
        pair = similarity.apply(first), similarity.apply(second)
        doubt = placement_doubt(*(surface.extent for surface in pair))
        radius = second.bounding_sphere[1] if options.no_scaling else 1.0
        for line in _remarks({options.a.name: first, options.b.name: second}, doubt, radius, options.unit):
            echo(f"note: {line}", err=True)
        # Bad settings are refused before a long computation.
        nearness, deviations = None, None
        if options.proximity:
            nearness, deviations = proximity_and_deviations(first, second, threshold=options.threshold)
        elif options.unit is not None:
            deviations = largest_deviation(first, second)
        changes = CHANGES if options.yardsticks else ("moved",)
        results = yardsticks(*pair, orders, **accuracy, changes=changes)
        return cls(options, first, second, similarity, results, nearness, deviations, motion, doubt)

    @property
    def area_change(self) -> float:
        """Area of A over that of B, minus one."""
        return self.first.area / self.second.area - 1

    @property
    def document(self) -> dict[str, Any]:
        """All numbers, for programs."""
        from sobolev_batch.norms.columns import parts_as_variables

        motion, before = self.motion or (None, None)
        return {
            "a": self.options.a,
            "b": self.options.b,
            "area_change": self.area_change,
            **vars(self.similarity),
            "orders": parts_as_variables(self.results).to_dataframe().reset_index().to_dict(orient="records"),
            "motion": None if motion is None else motion.tolist(),
            "before": None if before is None else before["relative"].item(),
            "settings": self.results.attrs,
            "proximity": self.nearness,
            "deviation": None if self.deviations is None else asdict(self.deviations),
            "doubt": self.doubt,
            "defects": {"a": self.first.defects, "b": self.second.defects},
            "notes": {"a": self.first.notes, "b": self.second.notes},
            "unit": self.options.unit,
        }

    @property
    def lines(self) -> Iterator[str]:
        """The same for people."""
        from sobolev_batch.tables.text import percent
        from sobolev_batch.testing.within import deviation_text

        options, length = self.options, self.options.unit or FILE_UNITS
        name, reference, radius = options.a.name, options.b.name, self.second.bounding_sphere[1]
        if self.deviations is not None:
            largest = deviation_text(self.deviations.both, length)
            yield f"The largest deviation of {name} and {reference} from each other is {largest}."
        if self.motion is not None:
            motion, before = self.motion
            yield f"where it is in the file: {percent(before['relative'].item(), before['relative_error'].item())}"
            yield _motion_text(motion)
        rtol = options.accuracy["rtol"]
        yield from _answers(name, reference, self.results, self.area_change, radius, length)
        yield from _details(self.results, rtol, is_whole=options.verbose)
        if options.verbose:
            origin = " ".join(f"{x:.6g}" for x in self.similarity.origin)
            yield (
                f"distances of orders are in {length}; the radius of {reference} is {radius:.6g}"
                if options.no_scaling
                else f"distances of orders are in radii of {reference}, {radius:.6g} {length} each "
                f"(scale {self.similarity.scale:.6g}, origin {origin})"
            )
        if self.nearness is not None and self.deviations is not None:
            for direction, way in (("A to B", self.deviations.forward), ("B to A", self.deviations.backward)):
                yield f"largest deviation, {direction}: {deviation_text(way, options.unit)}"
            yield from _proximity_lines(self.nearness, (self.first, self.second), length)

    def write_witness(self, path: Path) -> str:
        """Write or draw where the meshes differ, and return a line about it; see `write_difference`."""
        from sobolev_batch.testing.difference import write_difference

        options = self.options
        unit = (options.unit or FILE_UNITS) if options.proximity else None
        settings: dict[str, Any] = {"scaling": not options.no_scaling, "names": (options.a.name, options.b.name)}
        return write_difference(self.first, self.second, path, options.chosen_orders[0], **settings, distances=unit)


def _moved(mesh: Mesh, motion: Reals) -> Mesh:
    """Return a mesh after a rigid motion (4, 4)."""
    from sobolev_batch.geometry.mesh import Mesh

    return Mesh(mesh.vertices @ motion[:3, :3].T + motion[:3, 3], mesh.triangles, mesh.notes)


def _motion_text(motion: Reals) -> str:
    """Return a rigid motion (4, 4) in words, with its numbers."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec(degrees=True)
    angle = math.hypot(*vector)
    # What rounding makes of zero would be read as a motion.
    moved = np.where(np.abs(motion[:3, 3]) < _NO_MOTION * np.abs(motion[:3, 3]).max(), 0.0, motion[:3, 3])
    axis, shift = (" ".join(f"{x:.6g}" for x in numbers) for numbers in (vector / (angle or 1.0), moved))
    if angle < _NO_MOTION:
        return f"moved: shifted by ({shift})"
    return f"moved: rotated by {angle:.6g} degrees around ({axis}) through the origin, then shifted by ({shift})"


def _remarks(meshes: Mapping[str, Mesh], doubt: str | None, size: float, unit: str | None) -> Iterator[str]:
    """Yield what may make one doubt a comparison: defects, notes, places, and a unit far from their size."""
    yield from (f"{name}: {', '.join(mesh.defects)}" for name, mesh in meshes.items() if mesh.defects)
    yield from (f"{name}: {note}" for name, mesh in meshes.items() for note in mesh.notes)
    first = next(iter(meshes))
    if doubt is not None:
        yield f"{first}: {doubt}"
    if not 1 / _FAR_UNIT < size < _FAR_UNIT:
        yield (
            f"without scaling, wavelengths above 1 {unit or 'file unit'} weigh alike and shorter ones less, "
            f"and the reference has a radius of {size:.4g}; leave out --no-scaling to weigh them against it"
        )


def _proximity_lines(found: Mapping[str, float], meshes: tuple[Mesh, Mesh], unit: str) -> Iterator[str]:
    """Yield the usual distances in both directions, what is made of them, and the shapes of both meshes."""
    from sobolev_batch.tables.rendering import printed_table
    from sobolev_batch.tables.text import with_error

    rows = []
    for name, title in _DISTANCES.items():
        ending = " deg" if name.startswith("normal") else ""
        rows.append([title, *(f"{found[f'{name}{way}']:.4g}{ending}" for way in ("_forward", "_backward", ""))])
    yield from printed_table(rows, [f"in {unit}", "A to B", "B to A", "larger"], "text").split("\n")
    if not math.isnan(found["bias"]):
        signed = with_error(found["bias"], found["bias_error"])
        yield f"mean distance of A, positive outside of B and negative inside: {signed} (s.e.)"
    yield f"Chamfer, the sum of both means: {with_error(found['chamfer'], found['chamfer_error'])} (s.e.)"
    yield (
        f"F-score at {found['threshold']:.4g}: {100 * found['fscore']:.4g} % "
        f"({100 * found['precision']:.4g} % of A, {100 * found['recall']:.4g} % of B)"
    )
    for label, mesh in zip("AB", meshes, strict=True):
        volume = "not closed" if math.isnan(mesh.volume) else f"volume {mesh.volume:.6g}"
        angle, ratio = mesh.smallest_angles.min(), mesh.aspect_ratios.max()
        yield (
            f"{label}: {volume}, area {mesh.area:.6g}, smallest angle {angle:.3g} deg, aspect ratio at most {ratio:.3g}"
        )


def _answers(
    name: str, reference: str, results: xr.Dataset, area_change: float, radius: float, unit: str
) -> Iterator[str]:
    """Yield for each order a sentence, and then what is as far away; the radius of the reference is in a unit."""
    from sobolev_batch.tables.text import answer, likeness

    by_order = [results.sel(order=order) for order in results["order"].values]
    yield from dict.fromkeys(answer(name, reference, result, area_change) for result in by_order)
    for result in by_order:
        # Of equal meshes there is no more to tell.
        if result["distance"] > 0:
            text = likeness(visible(name), visible(reference), result, radius, unit)
            yield from text.split("\n") if text else ()


def _details(results: xr.Dataset, rtol: float | None, *, is_whole: bool) -> Iterator[str]:
    """Yield where an error is larger than requested, and if the whole is asked for, parts of errors and settings."""
    from sobolev_batch.tables.text import with_error

    for order in results["order"].values:
        result = results.sel(order=order)
        is_short = rtol is not None and not result["within"].item()
        remark = f"more than rtol {rtol:g}" if is_short else ""
        if is_whole and result["distance"] > 0:
            by_part = result["error_part"].to_series()
            parts = ", ".join(f"{name} {part:.0e}" for name, part in by_part.items() if name != "statistical" or part)
            value = with_error(result["distance"].item(), result["error"].item())
            yield f"order {order:g}: distance {value} ({parts}){remark and f', {remark}'}"
        elif is_short:
            yield f"order {order:g}: the error is {remark}"
    if is_whole and rtol is not None and "M" in results.attrs:
        yield _settings_text(results.attrs)


def _settings_text(attributes: Mapping[str, Any]) -> str:
    """Return what was chosen for an accuracy, on one line."""
    text = f"xi_max {attributes['xi_max']:.4g}, M {attributes['M']}, {attributes['dtype']}"
    if attributes["octaves"]:
        octaves = f"{attributes['octaves']} octave{'s' * (attributes['octaves'] != 1)}"
        text += f", {octaves} up to {attributes['highest_frequency']:.4g}"
    return f"{text}, seed {attributes['seed']}"


@cli.command("info")
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE...")
@json_option
def info_command(files: tuple[Path, ...], style: str) -> None:
    """Print what mesh files hold: counts, size, and what is unusual.

    Lengths are in the unit of each file. Edges of one triangle are open, and vertices of the same place are one.
    The aspect ratio of an equilateral triangle is 1.
    """
    from sobolev_batch.geometry.formats.readers import read_mesh

    facts = [_facts(path, read_mesh(path)) for path in files]
    echo_result(style, "\n".join(visible(line) for one in facts for line in _fact_lines(one)), {"files": facts})


def _fact_lines(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is known of a mesh, for people."""
    ends = list(zip("xyz", *facts["box"], strict=True))
    size = max(high - low for _, low, high in ends)
    # Far from the origin, coordinates need more digits.
    digits = 6 + math.ceil(math.log10(max(1.0, *(max(-low, high) / size for _, low, high in ends))))
    box = ", ".join(f"{axis} {low:.{digits}g} to {high:.{digits}g}" for axis, low, high in ends)
    extents = " by ".join(f"{high - low:.6g}" for _, low, high in ends)
    volume = "none: it is not closed" if math.isnan(facts["volume"]) else f"{facts['volume']:.6g}"
    yield f"{facts['file']}: {facts['triangles']:,} triangles, {facts['vertices']:,} vertices"
    yield f"  area {facts['area']:.6g}, volume {volume}"
    yield f"  box {box}: {extents}"
    yield (
        f"  smallest angle {facts['smallest_angle']:.3g}° (median {facts['smallest_angle_median']:.3g}°), "
        f"aspect ratio up to {facts['aspect_ratio']:.3g} (median {facts['aspect_ratio_median']:.3g})"
    )
    yield f"  {'; '.join(facts['defects']) or 'closed, all triangles face outwards'}"
    if facts["components"] > 1:
        closed = "" if facts["boundary_edges"] else "closed "
        inside = f", {facts['nested']:,} inside others" if facts["nested"] else ""
        yield f"  {facts['components']:,} {closed}components{inside}"
    if 2 * facts["duplicate_triangles"] == facts["triangles"]:
        yield "  every triangle is there twice"
    yield from (f"  note: {note}" for note in facts["notes"])


def _facts(path: Path, mesh: Mesh) -> dict[str, Any]:
    """Return what is known of a mesh by itself, lengths in its own unit."""
    import numpy as np

    from sobolev_batch.geometry.parts import nested_parts

    merged = mesh.merged or mesh
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
        **merged.counts,
        "nested": nested_parts(merged),
        "defects": mesh.defects,
        "notes": mesh.notes,
    }
