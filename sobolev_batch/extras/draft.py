"""A first study file for a folder of meshes. What its files are for is guessed from their names and sizes."""

from __future__ import annotations

import json
import os
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath

from sobolev_batch.errors import MeshError, StudyError, written
from sobolev_batch.geometry.formats.by_name import is_mesh_name, mesh_stem
from sobolev_batch.geometry.formats.readers import expected_size, read_mesh
from sobolev_batch.shown import Shown, reasons
from sobolev_batch.sources.files import MOST_MESHES
from sobolev_batch.sources.names import caseless_key, label_problem, name_problem, natural_key, quoted
from sobolev_batch.study.schema import REFERENCE_LABEL, RESERVED
from sobolev_batch.study.study import Study, StudyCollection
from sobolev_batch.study.templates import METHOD, OBJECT
from sobolev_batch.visible import visible

# Bytes of files that are read as a whole; the header or the length of others gives their size.
_MOST_BYTES = 32 << 20
# Words in the names of references, and of folders that hold references.
_REFERENCE = re.compile(r"(?<![^\W\d_])(original|reference|ref|target|ground[\W_]*truth|gt)(?![^\W\d_])", re.IGNORECASE)
# Only in the names of folders that hold the files themselves: objects/cow/ is the folder of one object.
_REFERENCES = re.compile(r"(originals|references|targets|objects)", re.IGNORECASE)
# The size of a mesh at the end of its name: cow_500, cow-1k7, cow 20.5.
_SIZE = re.compile(r"\d+(?:[.,]\d+)?(?:[kKmM]\d*)?$")
_LONGEST_NAME = 100
# More families, or objects on a line, would hide what comes next.
_MOST_LINES, _MOST_OBJECTS = 10, 6
# What the optional decimated family has, as fractions of the triangles of the reference.
_FRACTIONS = (16, 8, 4, 2)
_FEWEST_TRIANGLES = 4

_STUDY = """\
# `sobolev-batch plan` says what this study would do, and how long that takes; `sobolev-batch run` computes it.

[study]
name = {name}

[accuracy]                 # of the distance of every mesh to the reference
rtol = 1e-2                # the largest relative error: 1 % of the distance itself
best_effort = true         # where that is out of reach, compute the nearest attainable accuracy and mark it

[norm]
orders = [-2.0]            # add -4.0 for the overall form, or -1.5 for finer details, which takes longer
{sections}
# More to ask for: remove the # in front of the lines.

# [compare]
# pairs = "all"            # the distance of every mesh to every other, not to the reference alone

# [proximity]              # the usual distances beside ours, also "mean", "rms", "percentiles", "fscore", "normals"
# metrics = ["hausdorff", "chamfer"]
"""
_REFERENCE_SECTION = """
[reference]                # {remark}
source = "files"
paths = [{path}]
"""
_FAMILY_SECTION = """
[[family]]
name = {name}
source = "files"
paths = [  # {size}
{paths}]
"""
_DECIMATED_SECTION = """
[[family]]
name = "quadric decimation"
source = "decimate"
mesh = {{ source = "files", paths = [{path}] }}
triangles = {sizes}
"""
_OBJECTS_SECTION = """
[objects]
meshes = [
{rows}]
"""
# The files of each object and method.
_Methods = Mapping[tuple[str, str], Sequence[PurePosixPath]]


@dataclass(frozen=True)
class StudyDraft(Shown):
    """A study file that was written for a folder of meshes; ``print(draft)`` tells what it holds and what to do next.

    Attributes:
        path: Path of the file.
        summary: Lines on the reference, and on the meshes of each family or object.
        left_out: Reason for each mesh file of the folder that the study does not name, by path.

    >>> from pathlib import Path
    >>> import sobolev_batch as sb
    >>> draft = sb.result_types.StudyDraft(Path("study.toml"), ("reference cow.ply, 500 triangles",), {})
    >>> print(draft)
    study.toml: reference cow.ply, 500 triangles
    next: sobolev-batch plan study.toml
          sobolev-batch run study.toml
    """

    path: Path
    summary: Sequence[str]
    left_out: Mapping[str, str]

    def __str__(self) -> str:
        file, more = shlex.quote(str(self.path)), len(self.summary) - _MOST_LINES
        families = [*self.summary[:_MOST_LINES], *([f"and {more} more"] if more > 0 else [])]
        left_out = [f"{name}: {text}" for name, text in reasons("left out", self.left_out)]
        following = [f"next: sobolev-batch plan {file}", f"      sobolev-batch run {file}"]
        return "\n".join(map(visible, [f"{self.path}: {families[0]}", *families[1:], *left_out, *following]))


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
    ...     sb.write_mesh(sb.shapes.icosphere(4), Path(folder, "original.ply"))
    ...     for level in (1, 2):
    ...         sb.write_mesh(sb.shapes.icosphere(level), Path(folder, f"ball_{level}.ply"))
    ...     draft = sb.init_study(folder, Path(folder, "study.toml"))
    ...     study = sb.Study.from_toml(draft.path)
    >>> draft.summary
    ('reference original.ply, 5,120 triangles', 'family ball: 2 meshes, 80 to 320 triangles')
    >>> study.orders
    (-2.0,)
    """
    folder, output = Path(folder), Path(output)
    if os.path.lexists(output):
        # Before files are looked at, which may take a while.
        raise StudyError(f"{output} exists already; name another file, or move it away")
    if not folder.is_dir():
        raise StudyError(f"{folder}: there is no such folder; name one with mesh files")
    # Links are followed, as the system follows them from the study file on.
    base = output.parent.resolve()
    below = PurePosixPath(Path(os.path.relpath(folder.resolve(), base)).as_posix())
    problem = _path_problem(str(below))
    if problem is not None:
        raise StudyError(f"{folder}: its path cannot be in a study file: {problem}; rename it")
    sizes, left_out = _look_at(folder)
    several = _several_objects(list(sizes))
    if several is None:
        sections, summary = _sections_of_one(_reference(folder, sizes, left_out), sizes, below)
    else:
        sections, summary = _sections_of_several(*several, below)
        used = {*several[0].values(), *(path for paths in several[1].values() for path in paths)}
        left_out |= {str(path): "its name is that of no object" for path in sizes if path not in used}
    text = _STUDY.format(name=_toml(_free_name(folder.resolve().name, fallback="study")), sections=sections)
    if several is None:
        # A study that cannot list its meshes is none to write down.
        len(Study.from_table(tomllib.loads(text), folder=base).members)
    else:
        StudyCollection.from_table(tomllib.loads(text), folder=base)
    with written(output, "the study", StudyError), output.open("x", encoding="utf-8", newline="\n") as file:
        file.write(text)
    return StudyDraft(output, summary, left_out)


def _look_at(folder: Path) -> tuple[dict[PurePosixPath, int], dict[str, str]]:
    """Return the number of triangles of each mesh file that a study can name, and the reason for each other file.

    Paths below the folder are in their natural order. Hidden files, stores, and links to folders are left out. Small
    files are read as a whole, up to some bytes together.
    """
    found: list[str] = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".") and not name.endswith(".zarr")]
        meshes = (Path(parent, name) for name in files if not name.startswith("."))
        found += [path.relative_to(folder).as_posix() for path in meshes if is_mesh_name(path)]
        if len(found) > MOST_MESHES:
            raise StudyError(f"{folder} has more than {MOST_MESHES} mesh files; name a folder with fewer")
    sizes: dict[PurePosixPath, int] = {}
    left_out: dict[str, str] = {}
    names: dict[str, str] = {}
    left = _MOST_BYTES
    for below in sorted(found, key=natural_key):
        other = names.setdefault(caseless_key(below), below)
        try:
            if other != below:
                raise MeshError(f"its name differs from that of {quoted(other)} only in case or accents; rename one")
            problem = _path_problem(below)
            if problem is not None:
                raise MeshError(f"its name cannot be in a study file: {problem}; rename it")
            (triangles, _), size = expected_size(folder / below), (folder / below).stat().st_size
            # A file without an expected size is of another format, damaged or empty.
            if size <= left or not triangles:
                left -= size
                triangles = len(read_mesh(folder / below).triangles)
            sizes[PurePosixPath(below)] = triangles
        except (MeshError, OSError) as error:
            left_out[below] = str(error).removeprefix(f"{folder / below}: ")
    return sizes, left_out


def _path_problem(path: str) -> str | None:
    """Describe why a path cannot be in a study file; None where it can."""
    if OBJECT in path or METHOD in path:
        return f"it holds {OBJECT} or {METHOD}, which study files replace"
    return label_problem(path)


def _is_called_reference(path: PurePosixPath) -> bool:
    """Tell whether the name of a file, or that of a folder on the way to it, is that of a reference."""
    folders = path.parent.parts
    return any(map(_REFERENCE.search, (mesh_stem(path), *folders))) or any(map(_REFERENCES.fullmatch, folders[-1:]))


def _reference(folder: Path, sizes: Mapping[PurePosixPath, int], left_out: Mapping[str, str]) -> PurePosixPath:
    """Return the finest file that is called a reference, or else the finest of all."""
    # Of equals the one with the shortest path: original.ply before original_2.ply.
    for path in sorted(sizes, key=lambda path: (not _is_called_reference(path), -sizes[path], len(str(path)))):
        with suppress(MeshError):
            read_mesh(folder / path)
            return path
    examples = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
    raise StudyError(
        f"{folder} holds no mesh file that can be read{': ' * bool(examples)}{examples}; name a folder with meshes"
    )


def _free_name(wanted: str, taken: Iterable[str] = (), fallback: str = "meshes") -> str:
    """Return a name for a family that no other has."""
    visible = "".join(c if c.isprintable() and c not in "/\\" else " " for c in wanted)
    name = " ".join(visible.split())[: _LONGEST_NAME - 10].strip() or fallback
    known = {caseless_key(other) for other in (*taken, REFERENCE_LABEL)}
    numbered = [name, *(f"{name} {number}" for number in range(2, len(known) + 3))]
    return next(candidate for candidate in numbered if caseless_key(candidate) not in known)


def _without_size(stem: str) -> str:
    return _SIZE.sub("", stem).strip(" _-.")


def _families(owned: Sequence[tuple[PurePosixPath, str]], own_folders: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the family of each file, which comes with its object, by its folder or by its name.

    Objects have folders of their own, which say nothing of families; a single object is called "".
    """
    folders = [[part for part in path.parent.parts if part not in own_folders[name]] for path, name in owned]
    shared = sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*folders, strict=False)))
    wanted = []
    for (path, name), parts in zip(owned, folders, strict=True):
        # What the name of the file says beside object and size; cowboy in the folder of cow is a family.
        rest = mesh_stem(path).removeprefix(name)
        rest = _without_size(mesh_stem(path) if rest[:1].isalnum() else rest)
        # With slashes, or the families of a/b and "a b" would be one.
        wanted.append("/".join(parts[shared:]) or rest or "".join(parts[-1:]))
    # Meshes of one object that are alone, in no folder of their own, are a family together.
    counts, names = Counter(wanted), dict[str, str]()
    for place, ((_, name), parts) in enumerate(zip(owned, folders, strict=True)):
        if not name and not parts[shared:] and counts[wanted[place]] == 1:
            wanted[place] = ""
    return [names.setdefault(one, _free_name(one, names.values())) for one in wanted]


def _several_objects(paths: Sequence[PurePosixPath]) -> tuple[dict[str, PurePosixPath], _Methods] | None:
    """Return the references by their objects, and the files of these; None where all files are of one object.

    There are several objects if several files are called references, and each has files of its name.
    """
    called = [path for path in paths if _is_called_reference(path)]
    references = {_object_of(path): path for path in called}
    are_names = all(
        name_problem(name, _LONGEST_NAME, RESERVED) is None and not name.startswith((".", "__")) for name in references
    )
    owned = [(path, owner) for path in paths if path not in called and (owner := _owner(path, references)) is not None]
    are_all_owners = references.keys() == {owner for _, owner in owned}
    if not are_names or not are_all_owners or not 2 <= len({*map(caseless_key, references)}) == len(called):
        return None
    methods: dict[tuple[str, str], list[PurePosixPath]] = {}
    own_folders = {name: (name, *path.parent.parts) for name, path in references.items()}
    for (path, name), family in zip(owned, _families(owned, own_folders), strict=True):
        methods.setdefault((name, family), []).append(path)
    return references, methods


def _object_of(reference: PurePosixPath) -> str:
    """Return the name of the object of a reference: cow of objects/cow.ply, cow/original.ply, cow_original.ply."""
    rest = _REFERENCE.sub("", mesh_stem(reference)).strip(" _-.")
    own = [part for part in reference.parent.parts if not _REFERENCE.search(part) and not _REFERENCES.fullmatch(part)]
    return rest or "".join(own[-1:])


def _owner(path: PurePosixPath, references: Mapping[str, PurePosixPath]) -> str | None:
    """Return the object that a file belongs to: the longest that its name begins with, or that of its folder."""
    stem = mesh_stem(path)
    # cow_big_500 is of cow_big, not of cow.
    beginnings = (stem[:end] for end in range(len(stem), 0, -1) if not stem[end : end + 1].isalnum())
    return next((name for name in (*beginnings, *path.parent.parts) if name in references), None)


def _sections_of_one(
    reference: PurePosixPath, sizes: Mapping[PurePosixPath, int], folder: PurePosixPath
) -> tuple[str, tuple[str, ...]]:
    """Return the sections of a study of one object, and what they hold."""
    path, triangles = str(folder / reference), sizes[reference]
    others = [(other, "") for other in sizes if other != reference]
    families: dict[str, list[PurePosixPath]] = {}
    for (other, _), family in zip(others, _families(others, {"": ()}), strict=True):
        families.setdefault(family, []).append(other)
    counts = [count for part in _FRACTIONS if (count := triangles // part) >= _FEWEST_TRIANGLES]
    if not families and not counts:
        raise StudyError(
            f"{reference} is the only mesh that can be read, and too small to decimate ({triangles} triangles); add "
            "meshes to compare with it"
        )
    remark = "its name says so" if _is_called_reference(reference) else "the mesh with the most triangles"
    sections = _REFERENCE_SECTION.format(remark=remark, path=_toml(path))
    summary = [f"reference {path}, {triangles:,} triangles"]
    for family, members in families.items():
        ends = dict.fromkeys(f"{end(sizes[member] for member in members):,}" for end in (min, max))
        size = f"{_count(len(members))}, {' to '.join(ends)} triangles"
        texts = "".join(f"    {_toml(str(folder / member))},\n" for member in members)
        sections += _FAMILY_SECTION.format(name=_toml(family), paths=texts, size=size)
        summary.append(f"family {family}: {size}")
    if counts:
        decimated = _DECIMATED_SECTION.format(path=_toml(path), sizes=counts)
        if families:
            lines = ["Compare with decimation: remove the # in front of these lines.", *decimated.split("\n")[1:-1]]
            decimated = "\n" + "".join(f"# {line}\n" for line in lines)
        sections += decimated
    return sections, tuple(summary)


def _sections_of_several(
    references: Mapping[str, PurePosixPath], methods: _Methods, folder: PurePosixPath
) -> tuple[str, tuple[str, ...]]:
    """Return the section of a study of several objects, which lists their meshes, and what it holds."""
    listed = [(name, REFERENCE_LABEL, path) for name, path in references.items()]
    counts: Counter[str] = Counter()
    for (name, method), paths in methods.items():
        listed += [(name, method, path) for path in paths]
        counts[method] += len(paths)
    rows = (
        f"    {{ object = {_toml(name)}, method = {_toml(method)}, path = {_toml(str(folder / path))} }},\n"
        for name, method, path in listed
    )
    names = list(references)
    more = f" and {len(names) - _MOST_OBJECTS} more" if len(names) > _MOST_OBJECTS else ""
    return _OBJECTS_SECTION.format(rows="".join(rows)), (
        f"{len(names)} objects: {', '.join(names[:_MOST_OBJECTS])}{more}",
        *(f"method {method}: {_count(count)}" for method, count in counts.items()),
    )


def _toml(text: str) -> str:
    """Return a text as TOML spells it, as JSON does."""
    return json.dumps(text, ensure_ascii=False)


def _count(number: int) -> str:
    return f"{number} mesh{'es' * (number != 1)}"
