"""Conformance of sources: a check that the author of a plug-in runs on a source of their own."""

from __future__ import annotations

import contextlib
import math
import pickle
import tempfile
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NoReturn
from unittest import mock

from pydantic import ValidationError

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.surfaces.formats.objects import SURFACE_KINDS
from sobolev_batch.surfaces.shapes.mesh import Mesh
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.names import duplicate_names, label_problem, quoted
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Member, Source

# Thousands of members travel to workers: a larger one carries a mesh.
_MOST_MEMBER_BYTES = 1 << 20
# Smaller meshes need no prediction of their size; for larger ones it may be too low by this factor.
_SMALL_TRIANGLES, _FACTOR = 10_000, 10
_UNKNOWN_KEY = "a_key_that_no_source_has"


def check_source(source: Source, folder: str | Path = ".", *, broken: Iterable[Source] = ()) -> None:
    """Check that a source and its members keep the promises that studies rely on.

    Run it in the tests of a package that adds a source, on a few small members; some must differ in a
    single parameter. It lists the members twice. It makes every surface twice, once from a pickled member in
    another working directory, and compares the two.

    Args:
        source: Source to check.
        folder: Folder of the study file, where the relative paths of the source start.
        broken: Sources of the same kind whose input is missing or damaged. Each must raise `StudyError`
            when it lists its members, or `MeshError` when it makes a surface.

    Raises:
        AssertionError: The source breaks promises; the message lists all of them.

    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> class Balls(sb.Source):
    ...     radii: list[float]
    ...
    ...     def members(self, folder: Path) -> tuple[sb.Member, ...]:
    ...         return tuple(sb.SurfaceMember("ball", -1, sb.Sphere(radius), {"ball": 1}) for radius in self.radii)
    >>> sb.check_source(Balls(radii=[1.0]))
    >>> sb.check_source(Balls(radii=[1.0, 2.0]))
    Traceback (most recent call last):
        ...
    AssertionError: Balls breaks 2 promises of a source:
    - members() returns the names 'ball', 'ball', which are the same but for case and accents; make them unique
    - the members 'ball' and 'ball' have equal fingerprints and different surfaces; add what tells them apart
    """
    folder = Path(folder).absolute()
    report = _Report()
    _check_parameters(source, report)
    _check_members(source, folder, report)
    for broken_source in broken:
        _check_broken(broken_source, folder, report)
    if report.problems:
        count = f"{len(report.problems)} promise{'s' if len(report.problems) > 1 else ''}"
        lines = "".join(f"\n- {problem}" for problem in report.problems)
        raise AssertionError(f"{type(source).__qualname__} breaks {count} of a source:{lines}")


class _Report:
    """The promises that a source breaks."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def require(self, kept: bool, problem: str) -> None:
        """Note a problem unless the promise is kept."""
        if not kept:
            self.problems.append(problem)

    @contextlib.contextmanager
    def attempt(self, action: str) -> Iterator[None]:
        """Note any error as a problem."""
        try:
            yield
        except Exception as error:
            self.problems.append(f"{action} raises {type(error).__name__}: {error}")


def _check_parameters(source: Source, report: _Report) -> None:
    try:
        type(source).model_validate({_UNKNOWN_KEY: 1})
        errors: list[str] = []
    except ValidationError as error:
        errors = [item["type"] for item in error.errors()]
    report.require("extra_forbidden" in errors, "it takes unknown keys; keep extra='forbid' in its model_config")
    report.require(bool(source.model_config.get("frozen")), "it can be changed; keep frozen=True in its model_config")
    with report.attempt("model_dump_json()"):
        source.model_dump_json()
    report.require(isinstance(source.libraries, tuple), "libraries is no tuple of names of distributions")
    for library in source.libraries:
        try:
            version(library)
        except (PackageNotFoundError, ValueError):
            report.problems.append(f"libraries has {library!r}, which is not installed; correct the name or install it")


def _check_members(source: Source, folder: Path, report: _Report) -> None:
    members, again = _listed(source, folder, report), _listed(source, folder, report)
    if not members or not again:
        return
    names, names_again = ([(member.name, member.level) for member in listing] for listing in (members, again))
    report.require(names == names_again, f"members() lists {quoted(names)} first and {quoted(names_again)} next")
    for group in duplicate_names(member.name for member in members):
        report.problems.append(
            f"members() returns the names {', '.join(map(quoted, group[:5]))}, which are the same but for case and "
            "accents; make them unique"
        )
    first_of: dict[str, tuple[Member, object]] = {}
    for member, twin in zip(members, again, strict=False):
        with report.attempt(f"the member {quoted(member.name)}"):
            _check_values(member, report)
            identity = _checked_identity(member, report)
            digest = member.fingerprint_digest()
            report.require(
                twin.fingerprint_digest() == digest,
                f"the member {quoted(member.name)} has another fingerprint when it is listed again",
            )
            first, first_identity = first_of.setdefault(digest, (member, identity))
            report.require(
                identity == first_identity,
                f"the members {quoted(first.name)} and {quoted(member.name)} have equal fingerprints and different "
                "surfaces; add what tells them apart",
            )


def _listed(source: Source, folder: Path, report: _Report) -> tuple[Member, ...]:
    """Return the members, listed where no mesh can be made."""
    members: object = ()
    with (
        report.attempt("members()"),
        mock.patch.object(Mesh, "__init__", _refuse_mesh),
        mock.patch.object(Mesh, "from_checked", _refuse_mesh),
    ):
        members = source.members(folder)
        if isinstance(members, tuple) and members and all(isinstance(member, Member) for member in members):
            return members
        raise TypeError(f"it returns {quoted(members)}, expected a tuple of at least one Member")
    return ()


def _refuse_mesh(*_: object, **__: object) -> NoReturn:
    raise RuntimeError("it makes a mesh; leave that to Member.load")


def _check_values(member: Member, report: _Report) -> None:
    label = f"the member {quoted(member.name)}"
    problem = label_problem(member.name)
    report.require(problem is None, f"{label} has a name that is no label: {problem}")
    report.require(
        type(member.level) is int and member.level >= -1,
        f"{label} has the level {member.level!r}, expected an integer from -1",
    )
    report.require(
        member.time is None or (isinstance(member.time, int | float) and math.isfinite(member.time)),
        f"{label} has the time {member.time!r}, expected a number or None",
    )


def _checked_identity(member: Member, report: _Report) -> object:
    """Return values that tell the surface of a member from others."""
    label = f"the member {quoted(member.name)}"
    size = member.expected_size()
    report.require(isinstance(size, ExpectedSize), f"{label} predicts {quoted(size)}, expected an ExpectedSize")
    pickled = pickle.dumps(member)
    report.require(
        len(pickled) <= _MOST_MEMBER_BYTES,
        f"{label} takes {len(pickled)} bytes when it is pickled, {_MOST_MEMBER_BYTES} are allowed; make its surface "
        "in load()",
    )
    surface = member.load()
    if not isinstance(surface, SURFACE_KINDS):
        report.problems.append(
            f"{label} makes a {type(surface).__name__}, expected a Mesh, Sphere, Ellipsoid, Torus or "
            "ParametrisedSurface"
        )
        return None
    if isinstance(surface, Mesh):
        _check_size(size, surface, label, report)
    identity = _identity(surface)
    # A worker may run in any folder.
    with contextlib.chdir(tempfile.gettempdir()):
        copy = pickle.loads(pickled)  # noqa: S301 -- the bytes were made above
        report.require(
            copy.fingerprint_digest() == member.fingerprint_digest() and _identity(copy.load()) == identity,
            f"{label} makes another surface or fingerprint after pickling, in another working directory",
        )
    return identity


def _check_size(size: ExpectedSize, mesh: Mesh, label: str, report: _Report) -> None:
    count = len(mesh.triangles)
    mesh_bytes = mesh.vertices.nbytes + mesh.triangles.nbytes
    report.require(
        count < _SMALL_TRIANGLES or size.triangles * _FACTOR >= count,
        f"{label} predicts {size.triangles} triangles and makes {count}; predict them in expected_size()",
    )
    report.require(
        count < _SMALL_TRIANGLES or size.projected_bytes >= mesh_bytes,
        f"{label} predicts {size.projected_bytes:.0f} bytes for making a mesh of {mesh_bytes}; predict the peak of "
        "its memory in expected_size()",
    )


def _identity(surface: Surface) -> object:
    return surface.digest if isinstance(surface, Mesh) else (type(surface), surface.area, surface.extent)


def _check_broken(source: Source, folder: Path, report: _Report) -> None:
    label = f"the broken source {quoted(source)}"
    with report.attempt(label):
        try:
            members = source.members(folder)
        except StudyError:
            return
        for member in members:
            with contextlib.suppress(MeshError):
                member.fingerprint()
            try:
                member.load()
            except MeshError:
                continue
            report.problems.append(f"{label} makes the surface {quoted(member.name)}; expected a MeshError")
