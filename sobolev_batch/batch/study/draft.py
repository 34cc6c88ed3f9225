"""A first study file for a folder of meshes."""

from __future__ import annotations

import json
import os
import re
import shlex
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from sobolev_batch.batch.study.collection import METHOD, OBJECT, StudyCollection, is_collection
from sobolev_batch.batch.study.mesh_folder import Layout, MeshFile, free_name, guess_layout, with_any_size
from sobolev_batch.batch.study.plan import members_of
from sobolev_batch.batch.study.study import REFERENCE_LABEL, Study
from sobolev_batch.errors import StudyError
from sobolev_batch.surfaces.formats.readers import mesh_stem
from sobolev_batch.surfaces.sources.files import FileMember, FileSource, expand
from sobolev_batch.visible import HAZARDOUS, reasons, table_html, visible

# More lines of one kind, or objects on a line, would hide what comes next.
_MOST_LINES, _MOST_OBJECTS = 10, 6
# Lists of paths are broken into lines where they are longer.
_LINE = 110
# What the optional decimated family has, as fractions of the triangles of the reference.
_FRACTIONS = (16, 8, 4, 2)
_FEWEST_TRIANGLES = 4

_HEAD = """\
# `sobolev-batch plan` says what this study would do, and how long that takes; `sobolev-batch run` computes it.

[study]
name = {name}

[accuracy]                 # of the distance of every mesh to the reference
rtol = 1e-2                # the largest relative error: 1 % of the distance itself
best_effort = true         # where that is out of reach, compute the nearest attainable accuracy and mark it

[norm]
orders = [-2.0, -4.0]      # -2 weighs details, -4 the overall form; -1.5 sees finer details and takes longer

"""
_TAIL = """
# More to ask for: remove the # in front of the lines.

# [proximity]              # Hausdorff and Chamfer distances beside ours; needs the extra "vtk"
# points = 10000
"""
_REFERENCE = """\
[reference]                # {remark}
source = "files"
{paths}
"""
_FAMILY = """
[[family]]
name = {name}
source = "files"
{paths}
"""
_DECIMATED = """
[[family]]
name = "quadric decimation"
source = "decimate"
mesh = {{ source = "files", paths = [{path}] }}
triangles = {sizes}
"""


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
        first, *others = self.summary
        left_out = [f"left out: {name}: {reason}" for name, reason in self.left_out.items()]
        file = shlex.quote(str(self.path))
        following = [f"next: sobolev-batch plan {file}", f"      sobolev-batch run {file}"]
        lines = [f"{self.path}: {first}", *_cut(others, "and"), *_cut(left_out, "left out:"), *following]
        return "\n".join(map(visible, lines))

    def _repr_html_(self) -> str:
        rows = [("", line) for line in self.summary[: _MOST_LINES + 1]]
        return table_html(f"Study file {self.path}", [*rows, *reasons("left out", self.left_out)])


def _cut(lines: Sequence[str], start: str) -> list[str]:
    more = len(lines) - _MOST_LINES
    return [*lines[:_MOST_LINES], *([f"{start} {more} more"] if more > 0 else [])]


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
    folder, output = Path(folder), Path(output)
    if os.path.lexists(output):
        # Before files are looked at, which may take a while.
        raise StudyError(f"{output} exists already; name another file, or move it away")
    layout = guess_layout(folder)
    # Links are followed, as the system follows them from the study file on.
    base = output.parent.resolve()
    relative = Path(os.path.relpath(folder.resolve(), base)).as_posix()
    if OBJECT in relative or METHOD in relative:
        raise StudyError(f"{folder}: its name holds {OBJECT} or {METHOD}, which study files replace; rename it")
    prefix = "" if relative == "." else f"{relative}/"
    sections, summary = (_one_object if "" in layout.references else _several_objects)(layout, base, prefix)
    text = f"{_HEAD.format(name=_toml(free_name(folder.resolve().name, fallback='study')))}{sections}{_TAIL}"
    table = tomllib.loads(text)
    if is_collection(table):
        StudyCollection.from_table(table, folder=base)
    else:
        members_of(Study.from_table(table, folder=base))
    try:
        data = text.encode("utf-8")
        with output.open("xb") as file:
            file.write(data)
    except (OSError, UnicodeEncodeError) as error:
        raise StudyError(f"{output}: no study can be written there: {getattr(error, 'strerror', error)}") from error
    return StudyDraft(output, summary, layout.left_out)


def _one_object(layout: Layout, base: Path, prefix: str) -> tuple[str, tuple[str, ...]]:
    """Return the sections of a study of one object, and what they hold."""
    reference = layout.references[""]
    path = f"{prefix}{reference.path}"
    sizes = [count for part in _FRACTIONS if (count := reference.triangles // part) >= _FEWEST_TRIANGLES]
    if not layout.files and not sizes:
        raise StudyError(
            f"{reference.path} is the only mesh that can be read, and too small to decimate "
            f"({reference.triangles} triangles); add meshes to compare with it"
        )
    remark = "its name says so" if reference.is_called_reference else "the mesh with the most triangles"
    sections = _REFERENCE.format(remark=remark, paths=_paths([path]))
    summary = [f"reference {path}, {reference.triangles:,} triangles"]
    for (_, family), files in layout.files.items():
        entries = _entries([f"{prefix}{file.path}" for file in files], base)
        sections += _FAMILY.format(name=_toml(family), paths=_paths(entries, _size(files)))
        summary.append(f"family {family}: {_size(files)}")
    if sizes:
        decimated = _DECIMATED.format(path=_toml(path), sizes=sizes)
        if layout.files:
            lines = ["Compare with decimation: remove the # in front of these lines.", *decimated.split("\n")[1:-1]]
            decimated = "\n" + "".join(f"# {line}\n" for line in lines)
        sections += decimated
    return sections, tuple(summary)


def _several_objects(layout: Layout, base: Path, prefix: str) -> tuple[str, tuple[str, ...]]:
    """Return the sections of a study of several objects, and what they hold."""
    wanted = {(name, REFERENCE_LABEL): {f"{prefix}{file.path}"} for name, file in layout.references.items()}
    wanted |= {key: {f"{prefix}{file.path}" for file in files} for key, files in layout.files.items()}
    references = {prefix + _replaced(file.path, name, OBJECT) for name, file in layout.references.items()}
    templates = {prefix + _template(file, *key) for key, files in layout.files.items() for file in files}
    everything = [file for files in layout.files.values() for file in files]
    sections = _REFERENCE.format(remark="of each object", paths=_paths(sorted(references))) + _FAMILY.format(
        name=_toml(METHOD), paths=_paths(sorted(templates), _size(everything))
    )
    if _named_files(_HEAD.format(name='"draft"') + sections, base) != wanted:
        rows = [
            f"    {{ object = {_toml(name)}, method = {_toml(method)}, path = {_toml(path)} }},\n"
            for (name, method), paths in wanted.items()
            for path in sorted(paths)
        ]
        sections = f"[objects]\nmeshes = [\n{''.join(rows)}]\n"
    names = list(layout.references)
    more = f" and {len(names) - _MOST_OBJECTS} more" if len(names) > _MOST_OBJECTS else ""
    counts: dict[str, int] = {}
    for (_, method), files in layout.files.items():
        counts[method] = counts.get(method, 0) + len(files)
    return sections, (
        f"{len(names)} objects: {', '.join(names[:_MOST_OBJECTS])}{more}",
        *(f"method {method}: {_count(count)}" for method, count in counts.items()),
    )


def _named_files(text: str, base: Path) -> dict[tuple[str, str], set[str]]:
    """Return the files of each object and method of a study of several objects; none if it is not valid."""
    files: dict[tuple[str, str], set[str]] = {}
    try:
        collection = StudyCollection.from_table(tomllib.loads(text), folder=base)
        for name, study in collection.studies.items():
            sources = {REFERENCE_LABEL: study.reference, **{family.name: family.source for family in study.families}}
            for method, source in sources.items():
                members = source.members(base) if isinstance(source, FileSource) else ()
                paths = (member.path for member in members if isinstance(member, FileMember))
                files[name, method] = _relative(paths, base)
    except (StudyError, re.error):
        # Names with wildcards or braces stand for others in a template.
        return {}
    return files


def _entries(paths: Sequence[str], base: Path) -> list[str]:
    """Return a glob for the files of each folder and ending if it matches these and no others, or else their paths."""
    kinds: dict[tuple[PurePosixPath, str], list[str]] = {}
    for path in map(PurePosixPath, paths):
        kinds.setdefault((path.parent, path.name.removeprefix(mesh_stem(Path(path)))), []).append(str(path))
    entries: list[str] = []
    for (folder, ending), alike in kinds.items():
        stems = {"*", with_any_size(mesh_stem(Path(alike[0])))} if len(alike) > 1 else set()
        globs = [str(folder / f"{stem}{ending}") for stem in sorted(stems) if "*" in stem]
        entries += [glob for glob in globs if _matches(glob, base) == set(alike)][:1] or alike
    return entries


def _matches(glob: str, base: Path) -> set[str]:
    try:
        return _relative(expand(base, glob), base)
    except StudyError:
        # A link leads out of the folder.
        return set()


def _relative(paths: Iterable[Path], base: Path) -> set[str]:
    return {Path(os.path.relpath(path, base)).as_posix() for path in paths}


def _template(file: MeshFile, name: str, method: str) -> str:
    """Return the path of a file with placeholders for object and method, and a wildcard for its size."""
    path = PurePosixPath(_replaced(_replaced(file.path, name, OBJECT), method, METHOD))
    stem = mesh_stem(Path(path))
    return str(path.with_name(with_any_size(stem) + path.name.removeprefix(stem)))


def _replaced(path: str, name: str, placeholder: str) -> str:
    """Return a path with a placeholder for a name: in place of whole folders, and of a whole word of the last part."""
    *folders, last = path.split("/")
    word = rf"(?<![^\W_]){re.escape(name)}(?![^\W_])"
    last = re.sub(word, lambda _: placeholder, last, count=1)
    return "/".join([*(placeholder if part == name else part for part in folders), last])


def _paths(entries: Iterable[str], remark: str = "") -> str:
    """Return the key `paths`, on several lines if it is long."""
    texts = [*map(_toml, entries)]
    comment = f"  # {remark}" * bool(remark)
    one_line = f"paths = [{', '.join(texts)}]{comment}"
    if len(one_line) <= _LINE:
        return one_line
    return "\n".join([f"paths = [{comment}", *(f"    {text}," for text in texts), "]"])


def _toml(text: str) -> str:
    """Return a text as TOML spells it."""
    # JSON spells it in the same way, but leaves some characters as they are that a terminal would obey or hide.
    # Lone surrogates, of names that are no UTF-8, have no spelling, and cannot be written.
    return HAZARDOUS.sub(
        lambda match: match[0] if match[0] >= "\ud800" else f"\\u{ord(match[0]):04x}",
        json.dumps(text, ensure_ascii=False),
    )


def _count(number: int) -> str:
    return f"{number} mesh{'es' * (number != 1)}"


def _size(files: Sequence[MeshFile]) -> str:
    """Return the number and the sizes of the meshes."""
    counts = sorted(file.triangles for file in files)
    sizes = f"{counts[0]:,}" if counts[0] == counts[-1] else f"{counts[0]:,} to {counts[-1]:,}"
    return f"{_count(len(files))}, {sizes} triangles"
