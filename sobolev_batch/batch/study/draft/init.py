"""Writing a first study file for a folder of meshes."""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Self

from sobolev_batch.batch.study.collection import StudyCollection, is_collection
from sobolev_batch.batch.study.draft.document import (
    PathText,
    decimated_sizes,
    listed_text,
    objects_text,
    size_text,
    study_text,
)
from sobolev_batch.batch.study.draft.layout import Layout, free_name, with_any_size
from sobolev_batch.batch.study.draft.mesh_files import MeshFile, MeshFolder
from sobolev_batch.batch.study.draft.objects import ObjectsLayout
from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.batch.study.study import Study
from sobolev_batch.batch.study.templates import METHOD, OBJECT
from sobolev_batch.errors import StudyError
from sobolev_batch.html import reasons, table_html
from sobolev_batch.surfaces.sources.files import FileMember, FileSource, expand
from sobolev_batch.visible import visible

# The method that marks the reference of an object in a list.
_REFERENCE = "reference"
# More lines of one kind, or objects on a line, would hide what comes next.
_MOST_LINES, _MOST_OBJECTS = 10, 6


@dataclass(frozen=True)
class StudyDraft:
    """A study file that was written for a folder of meshes; ``print(draft)`` tells what it holds and what to do next.

    Attributes:
        path: Path of the file.
        summary: Lines on the reference, and on the meshes of each family or object.
        left_out: Reason for each mesh file of the folder that the study does not name, by path.

    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> draft = sb.StudyDraft(Path("study.toml"), ("reference cow.ply, 500 triangles",), {})
    >>> print(draft)
    study.toml: reference cow.ply, 500 triangles
    next: sobolev-batch plan study.toml
          sobolev-batch run study.toml
    """

    path: Path
    summary: Sequence[str]
    left_out: Mapping[str, str]

    def __str__(self) -> str:
        return "\n".join(map(visible, self._lines()))

    def _repr_html_(self) -> str:
        rows = [("", line) for line in self.summary[: _MOST_LINES + 1]]
        return table_html(f"Study file {self.path}", [*rows, *reasons("left out", self.left_out)])

    def _lines(self) -> Iterator[str]:
        first, *others = self.summary
        yield f"{self.path}: {first}"
        yield from others[:_MOST_LINES]
        if len(others) > _MOST_LINES:
            yield f"and {len(others) - _MOST_LINES} more"
        for name, reason in list(self.left_out.items())[:_MOST_LINES]:
            yield f"left out: {name}: {reason}"
        if len(self.left_out) > _MOST_LINES:
            yield f"left out: {len(self.left_out) - _MOST_LINES} more files"
        file = shlex.quote(str(self.path))
        yield f"next: sobolev-batch plan {file}"
        yield f"      sobolev-batch run {file}"


def init_study(folder: str | Path = ".", output: str | Path = "study.toml") -> StudyDraft:
    """Write a study file for a folder of meshes, which runs as it is.

    The reference is the mesh that is called original, reference, target or ground truth, or else the one with the most
    triangles. Each folder is a family; the meshes of a single folder are families by their names without the number at
    the end. Where several files are called references and others belong to them by name, the study has several
    objects. Files are looked at, and only small ones are read.

    Args:
        folder: Folder with meshes, in it or in folders below.
        output: Path of the study file, which must not exist.

    Raises:
        StudyError: The folder has no mesh that can be read, or a single one that is too small to decimate; or the file
            exists or cannot be written.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sobolev_batch as sb
    >>> with TemporaryDirectory() as folder:
    ...     sb.write_mesh(sb.icosphere(4), Path(folder, "original.ply"))
    ...     for level in (1, 2):
    ...         sb.write_mesh(sb.icosphere(level), Path(folder, f"ball_{level}.ply"))
    ...     draft = sb.init_study(folder, Path(folder, "study.toml"))
    ...     study = sb.Study.from_toml(draft.path)
    >>> draft.summary
    ('reference original.ply, 5,120 triangles', 'family ball: 2 meshes, 80 to 320 triangles')
    >>> study.orders
    (-2.0, -4.0)
    """
    output = Path(output)
    if os.path.lexists(output):
        # Before files are looked at, which may take a while.
        raise _exists(output)
    meshes = MeshFolder.of(Path(folder))
    draft = _Draft.of(meshes, output)
    _write_new(output, draft.text)
    return StudyDraft(output, draft.summary, {**meshes.left_out, **draft.left_out})


def _write_new(path: Path, text: str) -> None:
    try:
        file = path.open("xb")
    except FileExistsError as error:
        raise _exists(path) from error
    except OSError as error:
        raise StudyError(f"{path}: no study can be written there: {error.strerror or error}") from error
    try:
        with file:
            file.write(text.encode("utf-8"))
    except (OSError, UnicodeEncodeError) as error:
        path.unlink()
        raise StudyError(f"{path}: the study cannot be written: {error}") from error


def _exists(path: Path) -> StudyError:
    return StudyError(f"{path} exists already; name another file, or move it away")


@dataclass(frozen=True)
class _Place:
    """The place of a study file, from which meshes are named.

    Attributes:
        base: Folder of the study file.
        prefix: What leads from there to the folder of the meshes, with a slash at its end, or nothing.
    """

    base: Path
    prefix: str

    def path(self, file: MeshFile) -> str:
        """Return the path of a file as the study names it."""
        return f"{self.prefix}{file.path}"

    def entries(self, files: Sequence[MeshFile]) -> list[str]:
        """Return globs for files, or their paths where a glob would match others."""
        kinds: dict[tuple[tuple[str, ...], str], list[MeshFile]] = {}
        for file in files:
            kinds.setdefault((file.folders, file.ending), []).append(file)
        return [entry for alike in kinds.values() for entry in self._shortened(alike)]

    def _shortened(self, files: Sequence[MeshFile]) -> list[str]:
        """Return a glob for files of one folder and ending, if one matches these and no others."""
        paths = [*map(self.path, files)]
        folder, slash, _ = paths[0].rpartition("/")
        ending = files[0].ending
        for stem in ("*", with_any_size(files[0].stem)):
            glob = f"{folder}{slash}{stem}{ending}"
            is_plain = not has_magic(glob.replace("*", "", 1))
            if len(paths) > 1 and is_plain and "*" in stem and self._matches(glob) == set(paths):
                return [glob]
        return paths

    def _matches(self, glob: str) -> set[str]:
        try:
            return {Path(os.path.relpath(path, self.base)).as_posix() for path in expand(self.base, glob)}
        except StudyError:
            # A link leads out of the folder.
            return set()

    def files_of(self, text: str) -> dict[tuple[str, str], set[str]]:
        """Return the files of each object and method of a study of several objects; none if it is not valid."""
        files: dict[tuple[str, str], set[str]] = {}
        try:
            collection = StudyCollection.from_table(tomllib.loads(text), folder=self.base)
            for name, study in collection.studies.items():
                sources = {_REFERENCE: study.reference, **{family.name: family.source for family in study.families}}
                for method, source in sources.items():
                    members = source.members(self.base) if isinstance(source, FileSource) else ()
                    files[name, method] = {
                        Path(os.path.relpath(member.path, self.base)).as_posix()
                        for member in members
                        if isinstance(member, FileMember)
                    }
        except (StudyError, re.error):
            # Names with wildcards or braces stand for others in a template.
            return {}
        return files

    def require_valid(self, text: str) -> None:
        """Refuse a study that cannot be read, or of which a family has no surfaces."""
        table = tomllib.loads(text)
        if is_collection(table):
            StudyCollection.from_table(table, folder=self.base)
        else:
            members_of(Study.from_table(table, folder=self.base))


@dataclass(frozen=True)
class _Draft:
    """The text of a study file.

    Attributes:
        text: Text.
        summary, left_out: See `StudyDraft`.
    """

    text: str
    summary: Sequence[str]
    left_out: Mapping[str, str]

    @classmethod
    def of(cls, folder: MeshFolder, output: Path) -> Self:
        """Return the study of one object or of several, as the files suggest."""
        # Links are followed, as the system follows them from the study file on.
        base = output.parent.resolve()
        prefix = Path(os.path.relpath(folder.path.resolve(), base)).as_posix()
        if OBJECT in prefix or METHOD in prefix:
            raise StudyError(
                f"{folder.path}: its name holds {OBJECT} or {METHOD}, which study files replace; rename it"
            )
        place = _Place(base, "" if prefix == "." else f"{prefix}/")
        name = free_name(folder.path.resolve().name, (), "study")
        layout = ObjectsLayout.of(folder)
        if layout is None:
            return cls._of_one(Layout.of(folder), place, name)
        return cls._of_several(layout, place, name)

    @classmethod
    def _of_one(cls, layout: Layout, place: _Place, name: str) -> Self:
        reference = layout.reference
        if not layout.families and not decimated_sizes(reference.triangles):
            raise StudyError(
                f"{reference.path} is the only mesh that can be read, and too small to decimate "
                f"({reference.triangles} triangles); add meshes to compare with it"
            )
        why = "its name says so" if layout.is_named else "the mesh with the most triangles"
        families = {
            family: PathText(place.entries(files), size_text(files)) for family, files in layout.families.items()
        }
        text = study_text(name, PathText([place.path(reference)], why), families, reference.triangles)
        place.require_valid(text)
        return cls(
            text,
            (
                f"reference {place.path(reference)}, {reference.triangles:,} triangles",
                *(f"family {family}: {size_text(files)}" for family, files in layout.families.items()),
            ),
            {},
        )

    @classmethod
    def _of_several(cls, layout: ObjectsLayout, place: _Place, name: str) -> Self:
        counts = Counter(one.method for one in layout.files)
        objects = list(layout.references)
        more = f" and {len(objects) - _MOST_OBJECTS} more" if len(objects) > _MOST_OBJECTS else ""
        templates = dict.fromkeys(f"{place.prefix}{one.template}" for one in layout.files)
        text = objects_text(
            name,
            PathText([place.prefix + template for template in layout.reference_templates]),
            PathText([*templates], size_text([one.file for one in layout.files])),
        )
        wanted = {(name_of, _REFERENCE): {place.path(file)} for name_of, file in layout.references.items()}
        for one in layout.files:
            wanted.setdefault((one.object, one.method), set()).add(place.path(one.file))
        if place.files_of(text) != wanted:
            rows = [(one, method, path) for (one, method), paths in wanted.items() for path in sorted(paths)]
            text = listed_text(name, rows)
        place.require_valid(text)
        return cls(
            text,
            (
                f"{len(layout.references)} objects: {', '.join(objects[:_MOST_OBJECTS])}{more}",
                *(f"method {method}: {count} mesh{'es' * (count != 1)}" for method, count in counts.items()),
            ),
            layout.left_out,
        )
