"""Meshes reduced as far as a tolerance permits, many at a time: each trial is a task, and its outcome is recorded."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path, PurePath
from typing import Any

import pandas as pd
from distributed import Client
from pydantic import ValidationError

from sobolev_batch.batch.cluster.clients import check_cluster, local_client
from sobolev_batch.batch.cluster.execution import Cluster, Stages, Task, result_from, side_by_side, wait_for
from sobolev_batch.batch.cluster.workers import Workers, prepare_workers
from sobolev_batch.errors import ClusterError, InputError, MeshError, one_line
from sobolev_batch.geometry.formats.by_name import WRITERS, mesh_format
from sobolev_batch.geometry.formats.conversion import MeshLike, as_mesh
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.machine import available_cores
from sobolev_batch.norms.columns import ANGLE, FILE_LENGTH, VARIABLES
from sobolev_batch.parameters import callback
from sobolev_batch.reduction.limit import HAUSDORFF, RELATIVE, Limit, tried
from sobolev_batch.reduction.recorded import RecordedSearch
from sobolev_batch.reduction.remesher import Method, Range, Remesher
from sobolev_batch.reduction.search import PRECISION, Bracket, Trial
from sobolev_batch.sources.files import FileMember, matching_files, names_of_files
from sobolev_batch.sources.mesh_cache import InMemory, MeshCache
from sobolev_batch.sources.names import duplicate_names, label_problem, quoted
from sobolev_batch.sources.registry import MadeMember, Member, SurfaceMember
from sobolev_batch.store.location import Location
from sobolev_batch.store.objects import ends_all
from sobolev_batch.tables import Format
from sobolev_batch.tables.rendering import Column, Section, rendered
from sobolev_batch.tables.text import between, count, duration

# Sizes of one mesh that are tried at a time, where workers are idle: more save hardly any time.
_MOST_AT_ONCE = 4
# A search over fewer triangles takes less time than processes take to start.
_SMALL = 100_000
_NOTHING_KNOWN = Bracket(None, None, is_monotone=True)
# What a row has of the best mesh, and of the next smaller one that failed.
_OF_TRIALS = ("triangles", "size", "lower", "upper")


@dataclass(frozen=True, repr=False)
class Reduction:
    """The fewest triangles of one mesh within a tolerance.

    Attributes:
        name: Name of the mesh.
        limit: The tolerance: its ``value``, its ``measure`` and, of a Sobolev distance, its ``order``.
        original_triangles: Number of triangles of the mesh; 0 if it cannot be read.
        trials: What was tried, in this order.
        bracket: The ``best`` mesh, of the fewest triangles within the tolerance, and the next coarser one that
            ``failed``. ``is_monotone`` is false where a finer mesh was worse: then a smaller one may hold.
        reason: Why there is no mesh; empty where there is one.
        path: Where the mesh was written; empty without an output.
        mesh: The mesh, where there is no output.
        remarks: What one should know of the result, a sentence each.

    >>> import sobolev_batch as sb
    >>> found = sb.reduce(sb.shapes.icosphere(3), within=0.05)["mesh"]
    >>> found
    Reduction(mesh: 104 of 1,280 triangles, 4 trials)
    >>> found.bracket.best.upper <= 0.05 < found.bracket.failed.upper, found.mesh.defects
    (True, ())
    """

    name: str
    limit: Limit
    original_triangles: int = 0
    trials: tuple[Trial, ...] = ()
    bracket: Bracket = _NOTHING_KNOWN
    reason: str = ""
    path: str = ""
    mesh: Mesh | None = field(default=None, compare=False)
    remarks: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Reduction({self})"

    def __str__(self) -> str:
        """Return the result in a line."""
        if (best := self.bracket.best) is None:
            return f"{self.name}: {self.reason}"
        counts = f"{best.triangles:,} of {self.original_triangles:,} triangles, {len(self.trials)} trials"
        return "; ".join((f"{self.name}: {counts}", *self.remarks))

    def to_row(self) -> dict[str, Any]:
        """Return the row of a table; bounds are lengths in the unit of the meshes, degrees or fractions."""
        best, failed = (
            replace(one, lower=1 - one.upper, upper=1 - one.lower) if one and self.limit.is_score else one
            for one in (self.bracket.best, self.bracket.failed)
        )
        return {
            "object": self.name,
            "measure": self.limit.measure,
            "original_triangles": self.original_triangles,
            **{name: getattr(best, name, None) for name in _OF_TRIALS},
            **{f"failed_{name}": getattr(failed, name, None) for name in _OF_TRIALS},
            "trials": len(self.trials),
            "seconds": sum(one.seconds for one in self.trials),
            "is_monotone": self.bracket.is_monotone,
            "note": self.reason or "; ".join(self.remarks),
            "path": self.path,
        }


def format_reductions(found: Mapping[str, Reduction], style: Format = "text", unit: str | None = None) -> str:
    """Return a row for each mesh, as text, Markdown or LaTeX for people, or as CSV or JSON for programs."""
    limit = next(iter(found.values())).limit
    signs = {FILE_LENGTH: f" {unit}" if unit else "", ANGLE: "°"}
    factor, sign = (1, signs[limit.units]) if limit.units in signs else (100, " %")
    headers = {HAUSDORFF: "deviation", RELATIVE: "distance", "area": "change of area", "volume": "change of volume"}
    columns = [
        Column("object", "object", kind="label"),
        Column("original_triangles", "original", count),
        Column("triangles", "triangles", count),
        Column(
            "lower",
            headers.get(limit.measure, limit.measure),
            lambda lower, upper: between(factor * lower, factor * upper, sign),
            error="upper",
        ),
        Column("failed_triangles", "next that failed", count),
        Column("trials", "trials"),
        Column("seconds", "time", duration),
        Column("note", "note", kind="text"),
    ]
    frame = pd.DataFrame([one.to_row() for one in found.values()])
    frame = frame.astype({"triangles": "Int64", "failed_triangles": "Int64"})
    title = VARIABLES[limit.measure]["long_name"].removeprefix("lower bound of the ")
    of = {HAUSDORFF: "", RELATIVE: f" at order {limit.order or 0:g}"}.get(limit.measure, f": {title}")
    within = "of at least" if limit.is_score else "within"
    caption = f"fewest triangles {within} {factor * limit.value:.6g}{sign}{of}"
    return rendered(style, frame, [Section(caption, [(columns, frame)])], [])


def reduce(
    meshes: MeshLike | Sequence[str | Path] | Mapping[str, MeshLike],
    within: float | str,
    *,
    order: float | None = None,
    measure: str | None = None,
    unit: str | None = None,
    method: Method = "decimate",
    search: Range | None = None,
    precision: float = PRECISION,
    output: str | Path | None = None,
    client: Client | None = None,
    workers: int | None = None,
    on_progress: Callable[[Reduction], None] | None = None,
) -> dict[str, Reduction]:
    """Find the fewest triangles with which each mesh is still within a tolerance of itself.

    Bounds decide, and a sample only of measures that have no others. A mesh that is not certainly within the tolerance
    counts as one that is not. What was tried is recorded in the output, so that the same call goes on where it ended.

    Args:
        meshes: A mesh, the path of a file or a glob, a list of these paths, or meshes by name. Files are in one unit.
        within: The tolerance: a length for the largest deviation, as a number in the unit of the files or a text such
            as "0.1 mm"; or a text such as "1%" for the Sobolev distance over the norm of the original.
        order: Order s < -1/2 of this distance; default -2.
        measure: What is to be within the tolerance, by its column in tables: "hausdorff", the largest deviation;
            "relative", this distance; "area" or "volume", of which the change counts; or another number of `proximity`,
            such as "rms", "mean_forward", "p95", "bias" or "normal_mean" (in degrees), with its error at 99 %: those of
            10,000 points, which may miss a spot. Of "fscore", "precision" and "recall", with points matched within 1 %
            of the radius, the tolerance is the least that is permitted, such as "95%".
        unit: Name of the unit of the files, which a length with a unit needs.
        method: Name of a source that makes meshes of a number of triangles ("decimate", "remesh"); a command with
            {input}, {output} and a parameter, which thereby is permitted to run; a function of a mesh and a parameter;
            or the table of a family without its mesh.
        search: Name of the parameter, and between which two values to search, such as ``{"hausd": (0.001, 1.0)}``;
            whole numbers for one that takes no others. Which end is coarse shows by itself. Default: triangles, from 4
            to those of the mesh.
        precision: Width of the last bracket, from the mesh that holds to the next coarser one that failed, as a
            fraction of the parameter.
        output: Folder or URL for the reduced meshes, under their own names, and for records; default none.
        client: Client of the cluster to compute on. By default, processes on this machine are started where there are
            several meshes, or a large one; a script must then guard its main part by ``if __name__ == "__main__"``.
        workers: Number of these processes; default one for each core. With one, this process computes.
        on_progress: Called with the result of each mesh.

    Returns:
        What was found for each mesh, by the name of its file, or "mesh". One that cannot be read, or of which nothing
        is within the tolerance, has a reason, and does not raise. Where no smaller mesh held, the original itself is
        found, and a remark says so.

    Raises:
        InputError: A parameter is wrong, a mesh is of no known kind, or the output would replace a mesh.
        StoreError: The output cannot be written.
        ClusterError: No cluster could start, or its scheduler was lost.

    >>> import sobolev_batch as sb
    >>> found = sb.reduce(sb.shapes.icosphere(3), within="2%", order=-4)["mesh"]
    >>> found.bracket.best.triangles < 1280, found.bracket.best.upper <= 0.02 < found.bracket.failed.upper
    (True, True)
    >>> sb.reduce(sb.shapes.icosphere(3), within=0.02, measure="rms")["mesh"].bracket.best.triangles < 640
    True
    """
    check_cluster(client, workers)
    notify = callback(on_progress)
    limit, remesher = Limit.parse(within, order, unit, measure), _permitted(method, search)
    # It refuses a wrong precision.
    remesher.search(limit, 1, 1.0, precision)
    folder = None if output is None else Location.parse(output).absolute()
    searches = [
        RecordedSearch(one, one, limit, remesher, folder or InMemory(), name, f"{name}{suffix}", precision)
        for name, (one, suffix) in _originals(meshes, folder).items()
    ]
    found, by_name = dict[str, Reduction](), {search.name: search for search in searches}
    for name, outcome in _outcomes(searches, client, workers):
        if isinstance(outcome, Exception):
            by_name[name].forget()
        found[name] = outcome if isinstance(outcome, Reduction) else Reduction(name, limit, reason=one_line(outcome))
        notify(found[name])
    return {name: found[name] for name in by_name}


def _permitted(method: Method, search: Range | None) -> Remesher:
    """Return a remesher that may run; InputError where none is meant."""
    try:
        remesher = Remesher.parse(method, search)
    except ValidationError as error:
        parts = [(*one["loc"], one["msg"].removeprefix("Value error, ")) for one in error.errors()]
        raise InputError("; ".join(": ".join(map(str, part)) for part in parts)) from error
    return replace(remesher, source=remesher.source.with_cache(MeshCache(InMemory(), may_run=True)))


def _outcomes(
    searches: Sequence[RecordedSearch], client: Client | None, workers: int | None
) -> Iterator[tuple[str, Reduction | Exception]]:
    processes = available_cores() if workers is None else workers
    here = client is None and (processes == 1 or (workers is None and len(searches) == 1 and _is_small(searches[0])))
    left = {search.name for search in searches}
    with ExitStack() as stack:

        @cache
        def cluster() -> Cluster:
            """Start the cluster, which is not needed where everything is recorded."""
            if here:
                return Cluster(None, Workers.of_this_machine(1))
            started = client or stack.enter_context(local_client(min(processes, _MOST_AT_ONCE * len(searches))))
            return Cluster(started, prepare_workers(started, searches[0].remesher.source.libraries), study="reduce")

        def at_once() -> int:
            return max(1, min(_MOST_AT_ONCE, cluster().workers.threads // len(left)))

        def is_fatal(error: Exception) -> bool:
            # Without a cluster, no other mesh fares better.
            return ends_all(error) or (isinstance(error, ClusterError) and not cluster.cache_info().currsize)

        runs = ((search.name, _searched(search, cluster, at_once)) for search in searches)
        for name, outcome in side_by_side(runs, is_fatal):
            left.discard(name)
            yield name, outcome


def _is_small(search: RecordedSearch) -> bool:
    """Tell whether a search takes no processes of its own."""
    with suppress(MeshError):
        return search.original.expected_size().triangles < _SMALL
    return True


def _searched(search: RecordedSearch, cluster: Callable[[], Cluster], at_once: Callable[[], int]) -> Stages[Reduction]:
    """Search for the fewest triangles of a mesh."""
    if (known := search.recorded()) is None:
        search.make_room()
        read = Task(search.begun, (), search.projected_bytes(0), label=search.name, stage="read")
        known = yield from result_from(cluster(), read)
    record = known

    def take(trial: Any) -> None:
        nonlocal record
        record = search.taken(record, trial)

    needed = search.projected_bytes(record.triangles)
    while search.next(record):
        tasks = [
            Task(tried, search.trial(record, size), needed, label=f"{search.name}/{size:g}", stage="trial")
            for size in search.next(record, at_once())
        ]
        yield from wait_for(cluster(), tasks, take, needed)
    reason, folder = search.reason(record), search.folder
    path = str(folder.below(search.mesh_key)) if isinstance(folder, Location) and not reason else ""
    mesh = None if reason or path else search.mesh(record)
    found = record.triangles, record.trials, search.bracket(record)
    return Reduction(search.name, search.limit, *found, reason, path, mesh, search.remarks(record))


def _given(name: str, mesh: MeshLike) -> Member:
    """Return a mesh as a member, which cannot be loaded where the mesh is broken; InputError where it is none."""
    try:
        made = as_mesh(mesh)
    except MeshError as error:
        return MadeMember(name, -1, _refused, {"refused": (problem := one_line(error))}, (problem,))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    return SurfaceMember(name, -1, made, {"mesh": made.digest})


def _refused(problem: str) -> Mesh:
    raise MeshError(problem)


def _originals(meshes: Any, folder: Location | None) -> dict[str, tuple[Member, str]]:
    """Return the meshes to reduce by their names, each with the suffix of the file to write into a folder."""
    if isinstance(meshes, str | os.PathLike):
        meshes = [meshes]
    if not isinstance(meshes, list | tuple) or not all(isinstance(one, str | os.PathLike) for one in meshes):
        by_name = meshes if isinstance(meshes, Mapping) else {"mesh": meshes}
        names = [*map(str, by_name)]
        if problem := next(filter(None, map(label_problem, names)), None if names else "there is none"):
            raise InputError(f"meshes to reduce need names of their own, found {quoted(names)}: {problem}")
        return {str(name): (_given(str(name), mesh), ".ply") for name, mesh in by_name.items()}
    paths = list(dict.fromkeys(path for one in meshes for path in matching_files(Path(), os.fspath(one))))
    # Names of files that lie in different folders are whole paths.
    names = ["_".join(part for part in PurePath(name).parts if part != "/") for name in names_of_files(paths)]
    if not names or duplicate_names(names):
        raise InputError(f"meshes to reduce need names of their own, found {', '.join(names) or 'no mesh'}")
    found: dict[str, tuple[Member, str]] = {}
    for name, path in zip(names, paths, strict=True):
        # Memory keeps the mesh as search records do.
        suffix = mesh_format(path) if folder is not None and mesh_format(path) in WRITERS else ".ply"
        if folder is not None and not folder.scheme and path.resolve() == Path(folder.name, name + suffix).resolve():
            raise InputError(f"{path}: the reduced mesh would replace it; name another folder for these")
        found[name] = FileMember(name, -1, path.absolute()), suffix
    return found
