"""Two mesh files, and how much they differ: the options of compare, its numbers, and what people read of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import click
import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from sobolev_batch.arrays import Reals
from sobolev_batch.cli.options import ChosenOrders
from sobolev_batch.cli.output import echo, show_step
from sobolev_batch.errors import require_writable
from sobolev_batch.geometry.deviation import Deviations, largest_deviation
from sobolev_batch.geometry.formats.readers import read_mesh
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.parts import nested_parts
from sobolev_batch.geometry.proximity import proximity_and_deviations
from sobolev_batch.geometry.surface import Similarity, placement_doubt
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.norms.columns import parts_as_variables
from sobolev_batch.norms.distances import distance
from sobolev_batch.norms.yardsticks import yardsticks
from sobolev_batch.parameters import fraction
from sobolev_batch.plugins import FEATURES, extra
from sobolev_batch.tables.rendering import printed_table
from sobolev_batch.tables.text import bound, percent, rounded, second_digit, with_error
from sobolev_batch.testing.difference import require_place, write_difference
from sobolev_batch.testing.verdict import same_surface
from sobolev_batch.testing.within import deviation_text, judge_deviation
from sobolev_batch.transform.lattice import Lattice
from sobolev_batch.visible import FILE_UNITS, visible

# Options that every verdict knows; those of one on a fraction of the norm, which chooses the accuracy of the distance
# itself; and those of one on a length.
_KNOWN = {"a", "b", "align", "within", "report", "style"}
_KNOWN_OF_FRACTIONS, _KNOWN_OF_LENGTHS = {"orders", "memory", "no_scaling"}, {"unit", "one_way"}

# A radius beyond it, or below its inverse, is far from the unit of length.
_FAR_UNIT = 10.0
# Default of compare, which then takes the nearest attainable accuracy.
_DEFAULT_RTOL = 1e-2
# A turn by less, in degrees, or a shift by less than this fraction of the largest one, is rounding.
_NO_MOTION = 1e-9
# Digits of a motion near the origin, and those of a double.
_MOTION_DIGITS, _MOST_DIGITS = 6, 16
# Surfaces whose distance, relative to the reference, is certainly smaller differ by rounding.
_ROUNDING, _OF_FILES = 1e-10, 1e-5
# A share of area is told if its error is no larger, and to whole per cents.
_LARGEST_SHARE_ERROR, _WHOLE_PERCENT = 0.1, 0.01
# Area is called lost or gained if the surface really lost or gained at least this fraction of what fits best.
_LEAST_CHANGE = 0.5
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
class CompareOptions:
    """The arguments and options of compare, by the names of its parameters; None where one is not given."""

    a: Path
    b: Path
    orders: ChosenOrders
    rtol: float | None
    memory: int | None
    best_effort: bool
    xi_max: float | None
    intervals: int | None
    proximity: bool
    threshold: float | None
    align: bool
    unit: str | None
    witness: Path | None
    report: Path | None
    no_scaling: bool
    within: str | None
    one_way: bool
    verbose: bool
    style: str

    def __post_init__(self) -> None:
        if self.within is not None:
            self._check_verdict()
        elif self.one_way:
            raise click.UsageError("--one-way goes with --within LENGTH; give that, or leave it out")
        elif self.threshold is not None and not self.proximity and self.report is None:
            raise click.UsageError("--threshold goes with --proximity or --report; give one, or leave it out")
        elif self.has_lattice and self.rtol is not None:
            raise click.UsageError("--rtol chooses the lattice; leave out --xi-max and --M")
        if self.report is not None:
            require_writable(self.report, "the report")

    def _check_verdict(self) -> None:
        allowed = self.allowed_fraction
        known = _KNOWN | (_KNOWN_OF_LENGTHS if allowed is None else _KNOWN_OF_FRACTIONS)
        # The page has the distance besides.
        known |= {"orders"} if self.report is not None else set()
        context = click.get_current_context()
        given = [
            parameter.opts[0]
            for parameter in context.command.params
            if parameter.name not in known and getattr(self, str(parameter.name)) not in (None, False)
        ]
        if given:
            asked = "a length" if allowed is None else "a percentage"
            left_out = ", ".join(sorted(given))
            raise click.UsageError(f"--within with {asked} gives a verdict and no numbers; leave out {left_out}")
        if allowed is not None and allowed >= 1:
            raise click.UsageError(f"--within takes a length, or less than 100 %, found {self.within}")
        if len(self.chosen_orders) > 1:
            raise click.UsageError("--within takes one --order")

    @property
    def allowed_fraction(self) -> float | None:
        """The fraction of the norm of B that the distance may have for a verdict; None for one on a length, or none."""
        return fraction(self.within) if self.within is not None and self.within.rstrip().endswith("%") else None

    def verdict(self) -> tuple[str, dict[str, Any]] | None:
        """The line and the numbers of the verdict that is asked for; None without one."""
        if self.within is None:
            return None
        numbers: dict[str, Any] = {"a": self.a, "b": self.b}
        a, b = self.meshes
        if self.motion is not None:
            a, numbers["motion"] = _moved(a, self.motion), self.motion.tolist()
            echo(f"note: {motion_text(self.motion, self.meshes[0])}", err=True)
        if (tolerance := self.allowed_fraction) is not None:
            (order,), scaling = self.chosen_orders, not self.no_scaling
            same = same_surface(a, b, tolerance=tolerance, order=order, scaling=scaling, memory=self.memory)
            return f"{self.names[0]}: {same}", vars(same) | numbers | {"distance": same.distance, "error": same.error}
        near = judge_deviation(a, b, self.within, self.unit, one_way=self.one_way, names=self.names)
        numbers |= {"outcome": near.outcome, "length": near.length, "unit": near.unit, "doubt": near.doubt}
        numbers |= {"beyond": near.beyond, "beyond_of": "ab"[near.beyond_of] if near.outcome == "not within" else None}
        return f"{self.names[0]}: {near}", numbers | asdict(near.largest) | asdict(near.deviations)

    @cached_property
    def meshes(self) -> tuple[Mesh, Mesh]:
        """The meshes in both files, each read once."""
        return read_mesh(self.a), read_mesh(self.b)

    @cached_property
    def motion(self) -> Reals | None:
        """Rigid motion (4, 4) that brings A nearest to B; None if not asked for."""
        if not self.align:
            return None
        return np.asarray(extra(FEATURES, "align", "--align")(*self.meshes, order=self.chosen_orders[0]))

    @property
    def names(self) -> tuple[str, str]:
        """Names of both files, with their folders where these alone tell them apart."""
        a, b = self.a, self.b
        return (str(a), str(b)) if a.name == b.name else (a.name, b.name)

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
        settings = {"rtol": self.rtol, "memory": self.memory, "best_effort": self.best_effort}
        if self.has_lattice:
            xi_max = 5.0 if self.xi_max is None else self.xi_max
            return settings | {"lattice": Lattice(xi_max, 64 if self.intervals is None else self.intervals)}
        return settings if self.rtol is not None else settings | {"rtol": _DEFAULT_RTOL, "best_effort": True}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two meshes of files, and how much they differ.

    Attributes:
        first: The mesh of A in the unit of the file, where it was moved to.
        second: That of B.
        similarity: From this unit to that of the distances.
        results: What `yardsticks` returns.
        nearness: What `proximity` returns, in the unit of the files; None if not asked for.
        deviations: Largest deviations in this unit; None if it has no name and `proximity` was not asked for.
        before: The distance before A was moved; None if that was not asked for.
        doubt: Question whether both are in one unit and place; None where they look it.
        remarks: Reasons to doubt the comparison, this one too.
    """

    options: CompareOptions
    first: Mesh
    second: Mesh
    similarity: Similarity
    results: xr.Dataset
    nearness: dict[str, float] | None
    deviations: Deviations | None
    before: xr.Dataset | None
    doubt: str | None
    remarks: Sequence[str]

    @classmethod
    def of_files(cls, options: CompareOptions) -> Comparison:
        """Read and compare two files; what may make one doubt the result is printed as a note."""
        accuracy = options.accuracy
        first, second = options.meshes
        if options.witness is not None:
            require_place(options.witness)
        similarity = Similarity() if options.no_scaling else Similarity.to_unit_ball(second)
        orders, before = options.chosen_orders, None
        if options.motion is not None:
            before = distance(similarity.apply(first), similarity.apply(second), orders[0], **accuracy)
            first = _moved(first, options.motion)
        pair = similarity.apply(first), similarity.apply(second)
        doubt = placement_doubt(*(surface.extent for surface in pair))
        remarks = tuple(_remarks(options, first, second, doubt))
        for line in remarks:
            echo(f"note: {line}", err=True)
        # Bad settings are refused before a long computation.
        nearness, deviations = None, None
        show_step("distances of points")
        if options.proximity or options.report is not None:
            nearness, deviations = proximity_and_deviations(first, second, threshold=options.threshold)
        elif options.unit is not None:
            deviations = largest_deviation(first, second)
        results = yardsticks(*pair, orders, **accuracy, on_progress=show_step)
        return cls(options, first, second, similarity, results, nearness, deviations, before, doubt, remarks)

    @property
    def area_change(self) -> float:
        """Area of A over that of B, minus one."""
        return self.first.area / self.second.area - 1

    @property
    def document(self) -> dict[str, Any]:
        """All numbers, for programs."""
        motion = self.options.motion
        return {
            "a": self.options.a,
            "b": self.options.b,
            "area_change": self.area_change,
            **vars(self.similarity),
            "orders": parts_as_variables(self.results).to_dataframe().reset_index().to_dict(orient="records"),
            "motion": None if motion is None else motion.tolist(),
            "before": None if self.before is None else self.before["relative"].item(),
            "settings": self.results.attrs,
            "proximity": self.nearness,
            "deviation": None if self.deviations is None else asdict(self.deviations),
            "doubt": self.doubt,
            "defects": {"a": self.first.defects, "b": self.second.defects},
            "notes": {"a": self.first.notes, "b": self.second.notes},
            "unit": self.options.unit,
        }

    @property
    def unit(self) -> str:
        """Name of the unit of length of both files."""
        return self.options.unit or FILE_UNITS

    @property
    def lines(self) -> Iterator[str]:
        """The same for people."""
        yield from self.sentences
        if self.options.verbose:
            yield from self.details
        if self.nearness is not None and self.deviations is not None and self.options.proximity:
            for direction, way in (("A to B", self.deviations.forward), ("B to A", self.deviations.backward)):
                yield f"largest deviation, {direction}: {deviation_text(way, self.unit)}"
            yield from printed_table(self.rows, [f"in {self.unit}", "A to B", "B to A", "larger"], "text").split("\n")
            yield from _proximity_lines(self._resolved, (self.first, self.second), self.unit)

    @property
    def sentences(self) -> Iterator[str]:
        """Sentences on what was found, and on errors that are larger than requested."""
        rtol, by_order = self.options.accuracy["rtol"], self._by_order
        if self.deviations is not None:
            largest = deviation_text(self.deviations.both, self.unit)
            yield f"The largest deviation of {' and '.join(self.options.names)} from each other is {largest}."
        if self.options.motion is not None and self.before is not None:
            relative, error = (self.before[name].item() for name in ("relative", "relative_error"))
            yield f"where it is in the file: {percent(relative, error)}"
            yield motion_text(self.options.motion, self.options.meshes[0])
        yield from dict.fromkeys(answer(*self.options.names, result, self.area_change) for result in by_order)
        # Of equal meshes there is no more to tell.
        unequal = [result for result in by_order if result["distance"] > 0]
        for result in unequal:
            if text := likeness(visible(self.options.names[1]), result, self.second.bounding_sphere[1], self.unit):
                yield text
        for result in unequal:
            if rtol is not None and not result["within"]:
                yield f"order {result['order'].item():g}: the error is more than rtol {rtol:g}"

    @property
    def details(self) -> Iterator[str]:
        """Parts of the errors, and the settings that were chosen."""
        for result in self._by_order:
            if result["distance"] > 0:
                by_part = result["error_part"].to_series().items()
                parts = ", ".join(f"{name} {part:.0e}" for name, part in by_part if name != "statistical" or part)
                distance_text = with_error(result["distance"].item(), result["error"].item())
                yield f"order {result['order'].item():g}: distance {distance_text} ({parts})"
        if self.options.accuracy["rtol"] is not None and "M" in self.results.attrs:
            yield _settings_text(self.results.attrs)
        radius, origin = self.second.bounding_sphere[1], " ".join(f"{x:.6g}" for x in self.similarity.origin)
        yield (
            f"Sobolev distances are in {self.unit}; the radius of {self.options.names[1]} is {radius:.6g}"
            if self.options.no_scaling
            else f"Sobolev distances are in radii of {self.options.names[1]}, {radius:.6g} {self.unit} each "
            f"(scale {self.similarity.scale:.6g}, origin {origin})"
        )

    @property
    def rows(self) -> list[list[str]]:
        """The usual distances of points: their name, from A to B, from B to A, and the larger one."""
        found, rows = self._resolved, []
        for name, title in _DISTANCES.items() if found else ():
            ending = " deg" if name.startswith("normal") else ""
            rows.append([title, *(f"{found[f'{name}{way}']:.4g}{ending}" for way in ("_forward", "_backward", ""))])
        return rows

    @property
    def _resolved(self) -> dict[str, float]:
        """The usual distances, zero where they are less than the rounding of coordinates or angles."""
        farthest = float(np.abs([mesh.extent.box for mesh in (self.first, self.second)]).max())
        least = {True: 360 * np.finfo(float).eps, False: farthest * np.finfo(float).eps}
        found = self.nearness or {}
        return {name: 0.0 if abs(x) < least[name.startswith("normal")] else x for name, x in found.items()}

    @property
    def _by_order(self) -> list[xr.Dataset]:
        return [self.results.sel(order=order) for order in self.results["order"].values]

    def write_witness(self, path: Path) -> str:
        """Write or draw where the meshes differ, and return a line about it; see `write_difference`."""
        unit, order = self.unit if self.options.proximity else None, self.options.chosen_orders[0]
        names, scaling = self.options.names, not self.options.no_scaling
        return write_difference(self.first, self.second, path, order, scaling=scaling, names=names, distances=unit)


def _moved(mesh: Mesh, motion: Reals) -> Mesh:
    turn, shift = motion[:3, :3], motion[:3, 3]
    x, y, z = (-shift @ turn).tolist()
    return mesh.moved(1.0, (x, y, z), turn)


def motion_text(motion: Reals, mesh: Mesh) -> str:
    """Return a rigid motion (4, 4) of a mesh in words, with numbers that move it to a millionth of its radius or so."""
    center, radius = mesh.bounding_sphere
    # A rotation moves what is far from the origin by more.
    digits = min(_MOTION_DIGITS + math.ceil(math.log10(max(math.hypot(*center) / radius, 1.0))), _MOST_DIGITS)
    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec(degrees=True)
    angle = math.hypot(*vector)
    # What rounding makes of zero would be read as a motion.
    moved = np.where(np.abs(motion[:3, 3]) < _NO_MOTION * np.abs(motion[:3, 3]).max(), 0.0, motion[:3, 3])
    axis, shift = (" ".join(f"{x:.{digits}g}" for x in numbers) for numbers in (vector / (angle or 1.0), moved))
    if angle < _NO_MOTION:
        return f"moved: shifted by ({shift})"
    return f"moved: rotated by {angle:.{digits}g} degrees around ({axis}) through the origin, then shifted by ({shift})"


def _remarks(options: CompareOptions, first: Mesh, second: Mesh, doubt: str | None) -> Iterator[str]:
    """Yield what may make one doubt a comparison: defects, notes, inner parts, places, a unit far from the sizes."""
    named = list(zip(options.names, (first, second), strict=True))
    yield from (f"{name}: {', '.join(mesh.defects)}" for name, mesh in named if mesh.defects)
    yield from (f"{name}: {note}" for name, mesh in named for note in mesh.notes)
    nested = [(name, nested_parts(mesh.merged or mesh)) for name, mesh in named]
    yield from (f"{name}: components that lie inside others: {count:,}" for name, count in nested if count)
    if doubt is not None:
        yield f"{options.names[0]}: {doubt}"
    size = second.bounding_sphere[1] if options.no_scaling else 1.0
    if not 1 / _FAR_UNIT < size < _FAR_UNIT:
        yield (
            f"without scaling, wavelengths above 1 {options.unit or 'file unit'} weigh alike and shorter ones less, "
            f"and the reference has a radius of {size:.4g}; leave out --no-scaling to weigh them against it"
        )


def _proximity_lines(found: Mapping[str, float], meshes: tuple[Mesh, Mesh], unit: str) -> Iterator[str]:
    """Yield what is made of the usual distances in both directions, and the shapes of both meshes."""
    if not math.isnan(found["bias"]):
        signed = with_error(found["bias"], found["bias_error"])
        yield f"mean distance of A, positive outside of B and negative inside: {signed} {unit} (s.e.)"
    yield f"Chamfer, the sum of both means: {with_error(found['chamfer'], found['chamfer_error'])} {unit} (s.e.)"
    yield (
        f"F-score at {found['threshold']:.4g} {unit}: {100 * found['fscore']:.4g} % "
        f"({100 * found['precision']:.4g} % of A, {100 * found['recall']:.4g} % of B)"
    )
    for label, mesh in zip("AB", meshes, strict=True):
        cubic, square = (f"{value:.6g} {unit}^{power}" for value, power in ((mesh.volume, 3), (mesh.area, 2)))
        volume = "not closed" if math.isnan(mesh.volume) else f"volume {cubic}"
        angle, ratio = mesh.smallest_angles.min(), mesh.aspect_ratios.max()
        yield f"{label}: {volume}, area {square}, smallest angle {angle:.3g} deg, aspect ratio at most {ratio:.3g}"


def _settings_text(attributes: Mapping[str, Any]) -> str:
    text = f"xi_max {attributes['xi_max']:.4g}, M {attributes['M']}, {attributes['dtype']}"
    if attributes["octaves"]:
        octaves = f"{attributes['octaves']} octave{'s' * (attributes['octaves'] != 1)}"
        text += f", {octaves} up to {attributes['highest_frequency']:.4g}"
    return f"{text}, seed {attributes['seed']}"


def answer(name: str, reference: str, result: xr.Dataset | Mapping[str, float], area_change: float) -> str:
    """Return a sentence that says how much a surface differs from the reference, from `distance` at one order.

    The change of area is the area of the surface over that of the reference, minus one.
    """
    numbers = {key: float(result[key]) for key in ("distance", "error", "relative", "relative_error")}
    at_order = f"at order {float(result['order']):g}"
    if numbers["distance"] == numbers["error"] == 0:
        return f"{name} and {reference} are identical: they cover the same surface."
    if numbers["distance"] > numbers["error"]:
        amount = percent(numbers["relative"], numbers["relative_error"])
        return f"{name} differs from {reference} by {amount} {at_order}{_share_text(result, area_change)}."
    most = numbers["relative"] + numbers["relative_error"]
    if most < _OF_FILES:
        rounding = "rounding" if most < _ROUNDING else "the rounding of files"
        return f"{name} and {reference} are equal up to {rounding} {at_order}: they differ by less than {bound(most)}."
    amount = "an unknown amount" if math.isnan(most) else f"less than {bound(most)}"
    return f"{name} differs from {reference} by {amount} {at_order}: not resolved."


def likeness(reference: str, result: xr.Dataset | Mapping[str, float], radius: float, unit: str) -> str:
    """Return a sentence on the move that brings the reference as far from itself; nothing where none does.

    The radius is that of the reference in a unit.

    >>> likeness("large.obj", {"order": -2.0, "moved": 0.0081, "moved_error": 1e-4}, 50.0, "mm")
    'At order -2, this is as far as large.obj moved by 0.81 % of its radius, 0.405 mm.'
    """
    if math.isnan(moved := float(result["moved"])):
        return ""
    error = max(float(result["moved_error"]), second_digit(moved))
    fraction, own = (rounded(size * moved, size * error) for size in (100.0, radius))
    at_order = f"At order {float(result['order']):g}"
    return f"{at_order}, this is as far as {reference} moved by {fraction} % of its radius, {own} {unit}."


def _share_text(result: xr.Dataset | Mapping[str, float], area_change: float) -> str:
    """Return which share of a squared distance is a change of area; nothing where that is not known."""
    share, error, excess = (float(result[key]) for key in ("area_share", "area_share_error", "excess"))
    if not error <= _LARGEST_SHARE_ERROR:
        return ""
    if share + error < _WHOLE_PERCENT:
        return "; a uniform change of area explains less than 1 % of the squared distance"
    # A moved surface has lost no area, though a smaller multiple of the reference fits it best.
    if share <= error or not area_change / excess >= _LEAST_CHANGE:
        return ""
    amount = rounded(100 * share, 100 * max(error, _WHOLE_PERCENT), " %")
    return f"; a uniform {'loss' if excess < 0 else 'gain'} of area explains {amount} of the squared distance"
