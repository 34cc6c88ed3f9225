"""Conformance of sources: a check that the author of a plug-in runs on a source of their own."""

import pickle
import tempfile
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.sources.names import duplicate_names, label_problem, quoted
from sobolev_batch.sources.registry import Source


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
    problems = [*_problems(source, Path(folder).absolute())]
    if problems:
        count = f"{len(problems)} promise{'s' if len(problems) > 1 else ''}"
        lines = "".join(f"\n- {problem}" for problem in problems)
        raise AssertionError(f"{type(source).__qualname__} breaks {count} of a source:{lines}")


def _problems(source: Source, folder: Path) -> Iterator[str]:
    members, again = source.members(folder), source.members(folder)
    names, names_again = ([(member.name, member.level) for member in listing] for listing in (members, again))
    if not names or names != names_again:
        yield f"members() lists {quoted(names)} first and {quoted(names_again)} next; list the same each time"
    for group in duplicate_names(member.name for member in members):
        alike = ", ".join(map(quoted, group[:5]))
        yield f"members() returns the names {alike}, which are the same but for case and accents; make them unique"
    first_of: dict[str, tuple[str, object]] = {}
    for member, twin in zip(members, again, strict=False):
        label, digest = f"the member {quoted(member.name)}", member.fingerprint_digest()
        identity = _identity(member.load())
        if (problem := label_problem(member.name)) is not None:
            yield f"{label} has a name that is no label: {problem}"
        if twin.fingerprint_digest() != digest:
            yield f"{label} has another fingerprint when it is listed again"
        first, first_identity = first_of.setdefault(digest, (member.name, identity))
        if identity != first_identity:
            yield f"{label} has the fingerprint of {quoted(first)} and another surface; add what tells them apart"
        # A worker may run in any folder.
        with chdir(tempfile.gettempdir()):
            copy = pickle.loads(pickle.dumps(member))  # noqa: S301 -- the bytes were just made
            if copy.fingerprint_digest() != digest or _identity(copy.load()) != identity:
                yield f"{label} makes another surface or fingerprint after pickling, in another working directory"


def _identity(surface: Surface) -> object:
    """Return values that tell a surface from others."""
    return surface.digest if isinstance(surface, Mesh) else (type(surface), surface.area, surface.extent)
