"""Conformance of sources: a check that the author of a plug-in runs on a source of their own."""

import contextlib
import pickle
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NoReturn
from unittest import mock

from sobolev_batch.geometry.formats.conversion import SURFACE_KINDS
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.sources.names import duplicate_names, label_problem, quoted
from sobolev_batch.sources.registry import Member, Source

# Thousands of members travel to workers: a larger one carries a mesh.
_MOST_MEMBER_BYTES = 1 << 20
# Smaller meshes need no prediction of their size; for larger ones it may be too low by this factor.
_SMALL_TRIANGLES, _FACTOR = 10_000, 10


def check_source(source: Source, folder: str | Path = ".") -> None:
    """Check that a source and its members keep the promises that studies rely on.

    Run it in the tests of a package that adds a source, on a few small members, some of which differ in one parameter.
    It lists members twice, and compares surfaces made twice, once from a pickled member in another working directory.

    Args:
        source: Source to check.
        folder: Folder of the study file, where the relative paths of the source start.

    Raises:
        AssertionError: The source breaks promises; the message lists all of them.

    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> class Balls(sb.sources.Source):
    ...     radii: list[float]
    ...
    ...     def members(self, folder: Path) -> tuple[sb.sources.Member, ...]:
    ...         balls = map(sb.shapes.Sphere, self.radii)
    ...         return tuple(sb.sources.SurfaceMember("ball", -1, ball, {"ball": 1}) for ball in balls)
    >>> sb.sources.check_source(Balls(radii=[1.0]))
    >>> sb.sources.check_source(Balls(radii=[1.0, 2.0]))
    Traceback (most recent call last):
        ...
    AssertionError: Balls breaks 2 promises of a source:
    - members() returns the names 'ball', 'ball', which are the same but for case and accents; make them unique
    - the member 'ball' has the fingerprint of 'ball' and another surface; add what tells them apart
    """
    folder = Path(folder).absolute()
    problems = [*_attempted("a parameter", _parameter_problems(source))]
    problems += _attempted("members()", _member_problems(source, folder))
    if problems:
        count = f"{len(problems)} promise{'s' if len(problems) > 1 else ''}"
        lines = "".join(f"\n- {problem}" for problem in problems)
        raise AssertionError(f"{type(source).__qualname__} breaks {count} of a source:{lines}")


def _attempted(action: str, problems: Iterable[str]) -> Iterator[str]:
    """Yield problems; any error in finding them is one too."""
    try:
        yield from problems
    except Exception as error:
        yield f"{action} raises {type(error).__name__}: {error}"


def _parameter_problems(source: Source) -> Iterator[str]:
    if source.model_config.get("extra") != "forbid":
        yield "it takes unknown keys; keep extra='forbid' in its model_config"
    if not source.model_config.get("frozen"):
        yield "it can be changed; keep frozen=True in its model_config"
    source.model_dump_json()


def _member_problems(source: Source, folder: Path) -> Iterator[str]:
    members, again = _listed(source, folder), _listed(source, folder)
    names, names_again = ([(member.name, member.level) for member in listing] for listing in (members, again))
    if names != names_again:
        yield f"members() lists {quoted(names)} first and {quoted(names_again)} next"
    for group in duplicate_names(member.name for member in members):
        yield (
            f"members() returns the names {', '.join(map(quoted, group[:5]))}, which are the same but for case and "
            "accents; make them unique"
        )
    first_of: dict[str, tuple[str, object]] = {}
    for member, twin in zip(members, again, strict=False):
        label = f"the member {quoted(member.name)}"
        yield from _attempted(label, (f"{label} {problem}" for problem in _own_problems(member, twin, first_of)))


def _listed(source: Source, folder: Path) -> tuple[Member, ...]:
    """Return the members, listed where no mesh can be made."""
    with mock.patch.multiple(Mesh, __init__=_refuse_mesh, from_checked=_refuse_mesh):
        members: object = source.members(folder)
    if isinstance(members, tuple) and members and all(isinstance(member, Member) for member in members):
        return members
    raise TypeError(f"it returns {quoted(members)}, expected a tuple of at least one Member")


def _refuse_mesh(*_: object, **__: object) -> NoReturn:
    raise RuntimeError("it makes a mesh; leave that to Member.load")


def _own_problems(member: Member, twin: Member, first_of: dict[str, tuple[str, object]]) -> Iterator[str]:
    """Yield what is wrong with a member and its twin; name and identity of the first by fingerprint are kept."""
    if (problem := label_problem(member.name)) is not None:
        yield f"has a name that is no label: {problem}"
    digest, pickled = member.fingerprint_digest(), pickle.dumps(member)
    if twin.fingerprint_digest() != digest:
        yield "has another fingerprint when it is listed again"
    if len(pickled) > _MOST_MEMBER_BYTES:
        yield (
            f"takes {len(pickled)} bytes when it is pickled, {_MOST_MEMBER_BYTES} are allowed; make its surface in "
            "load()"
        )
    size, surface = member.expected_size(), member.load()
    if not isinstance(surface, SURFACE_KINDS):
        yield f"makes a {type(surface).__name__}, expected a Mesh, Sphere, Ellipsoid, Torus or ParametrisedSurface"
        return
    if isinstance(surface, Mesh) and len(surface.triangles) >= _SMALL_TRIANGLES:
        count, mesh_bytes = len(surface.triangles), surface.vertices.nbytes + surface.triangles.nbytes
        if size.triangles * _FACTOR < count or size.projected_bytes < mesh_bytes:
            yield (
                f"predicts {size.triangles} triangles and {size.projected_bytes:.0f} bytes, and makes a mesh of "
                f"{count} and {mesh_bytes}; predict them in expected_size()"
            )
    identity = _identity(surface)
    first, first_identity = first_of.setdefault(digest, (member.name, identity))
    if identity != first_identity:
        yield f"has the fingerprint of {quoted(first)} and another surface; add what tells them apart"
    # A worker may run in any folder.
    with contextlib.chdir(tempfile.gettempdir()):
        copy = pickle.loads(pickled)  # noqa: S301 -- the bytes were made above
        if copy.fingerprint_digest() != digest or _identity(copy.load()) != identity:
            yield "makes another surface or fingerprint after pickling, in another working directory"


def _identity(surface: Surface) -> object:
    """Return values that tell a surface from others."""
    return surface.digest if isinstance(surface, Mesh) else (type(surface), surface.area, surface.extent)
