"""Globs: patterns of paths, expanded below the folder that they name and nowhere else."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from fnmatch import translate
from glob import has_magic
from pathlib import Path

from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.sources.names import quoted


def expand(folder: Path, pattern: str) -> list[Path]:
    """Return the files that match a pattern of ``**``, ``*``, ``?`` and ``[...]``.

    The part of the pattern before its first wildcard names a folder. Files outside of that folder are
    refused, since nobody would notice them: ``..`` after a wildcard, and links that lead out. Hidden files
    match only a part that begins with a dot; ``**`` follows no links to folders.

    Args:
        folder: Folder where relative patterns start.
        pattern: Pattern with at least one wildcard.

    Raises:
        StudyError: The pattern matches no file, or one outside its folder.
    """
    parts = Path(pattern).parts
    first = next(i for i, part in enumerate(parts) if has_magic(part))
    base, rest = folder.joinpath(*parts[:first]), parts[first:]
    glob = f"the glob {quoted(pattern, 300)}"
    if ".." in rest:
        raise StudyError(f"{glob} goes back up behind a wildcard; name the folder to search")
    paths = [base]
    for part in rest:
        # Without duplicates, or some patterns would take for ever.
        paths = list(dict.fromkeys(match for path in paths for match in _matches(path, part)))
    inside = Path(os.path.realpath(base))
    files = [path for path in paths if os.path.isfile(path)]
    if not files:
        raise StudyError(f"{glob} matches no file below {inside}; correct it, or put files there")
    for path in files:
        target = Path(os.path.realpath(path))
        if not target.is_relative_to(inside):
            raise StudyError(
                f"{glob} matches {str(path)!r}, a link out of {inside} to {target}; name such files by their paths"
            )
    return files


def _matches(folder: Path, part: str) -> Iterator[Path]:
    """Yield the paths in a folder that match one part of a pattern."""
    if part == "**":
        # Any number of folders; as the last part it stands for their files.
        yield folder
        for parent, folders, files in os.walk(folder):
            folders[:] = [
                name for name in folders if not name.startswith(".") and not os.path.islink(os.path.join(parent, name))
            ]
            for name in (*folders, *files):
                if not name.startswith("."):
                    yield Path(parent, name)
    elif not has_magic(part):
        if os.path.lexists(folder / part):
            yield folder / part
    else:
        matches = re.compile(translate(part)).match
        try:
            names = os.listdir(folder)
        except OSError:
            # A file, or a folder that may not be listed, matches nothing, as in a shell.
            return
        for name in names:
            if matches(name) and (part.startswith(".") or not name.startswith(".")):
                yield folder / name
