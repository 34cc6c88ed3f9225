"""Globs: patterns of paths, expanded below the folder that they name and nowhere else."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from fnmatch import translate
from glob import has_magic
from pathlib import Path

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.sources.names import shown


def expand(folder: Path, pattern: str) -> list[Path]:
    """The files that match a pattern of ``**``, ``*``, ``?`` and ``[...]``; hidden ones only where it says so.

    A pattern names a folder by what stands before its first wildcard. Files outside of it are not for
    a pattern to find: ``..`` behind a wildcard and links that lead out are refused, since nobody would see them.
    Links to folders are not followed by ``**``.

    Args:
        folder: where a relative pattern starts.
        pattern: with at least one wildcard.

    Raises:
        StudyError: a pattern that matches no file, or one outside its folder.
    """
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if has_magic(part))
    base, rest = folder.joinpath(*parts[:first]), parts[first:]
    quoted = shown(pattern, 300)
    if ".." in rest:
        raise StudyError(f"the glob {quoted} goes back up behind a wildcard; name the folder that it is to search")
    found = [base]
    for part in rest:
        # Each folder once, or some patterns would take for ever.
        found = list(dict.fromkeys(path for place in found for path in _step(place, part)))
    inside = Path(os.path.realpath(base))
    files = [path for path in found if os.path.isfile(path)]
    if not files:
        raise StudyError(f"the glob {quoted} matches no file below {inside}; correct it, or put files there")
    for path in files:
        target = Path(os.path.realpath(path))
        if not target.is_relative_to(inside):
            raise StudyError(
                f"the glob {quoted} matches {str(path)!r}, a link out of {inside} to {target}; "
                "name such files by their paths"
            )
    return files


def _step(folder: Path, part: str) -> Iterator[Path]:
    """What one part of a pattern leads to from a folder."""
    if part == "**":
        # Any number of folders; a last one stands for what is in them.
        yield folder
        for place, folders, files in os.walk(folder):
            folders[:] = [
                name for name in folders if not name.startswith(".") and not os.path.islink(os.path.join(place, name))
            ]
            for name in (*folders, *files):
                if not name.startswith("."):
                    yield Path(place, name)
    elif not has_magic(part):
        if os.path.lexists(folder / part):
            yield folder / part
    else:
        matches = re.compile(translate(part)).match
        try:
            names = os.listdir(folder)
        except OSError:
            # A file, or a folder that may not be listed, as for the shell.
            return
        for name in names:
            if matches(name) and (part.startswith(".") or not name.startswith(".")):
                yield folder / name
