"""A first study file for a folder of meshes. What its files are for is guessed from their names and sizes."""

import json
import os
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, product, starmap, takewhile
from pathlib import Path, PurePosixPath
from string import Template
from textwrap import indent

from sobolev_batch.batch.start import MADE_MESHES
from sobolev_batch.errors import MeshError, StudyError, written
from sobolev_batch.geometry.formats.by_name import is_mesh_name, mesh_stem
from sobolev_batch.geometry.formats.readers import expected_size, read_mesh
from sobolev_batch.geometry.surface import Extent, placement_doubt
from sobolev_batch.parameters import path_of
from sobolev_batch.shown import Shown, few_of, reasons, together
from sobolev_batch.sources.files import MOST_MESHES, FileMember
from sobolev_batch.sources.names import caseless_key, label_problem, name_problem, natural_key, quoted
from sobolev_batch.study.schema import REFERENCE_LABEL, RESERVED
from sobolev_batch.study.study import Study
from sobolev_batch.study.templates import METHOD, OBJECT
from sobolev_batch.visible import visible

# Bytes of files that are read as a whole; the header or the length of others gives their size.
_MOST_BYTES = 32 << 20
# Words in the names of references, and of folders that hold references.
_REFERENCE = re.compile(r"(?<![^\W\d_])(original|reference|ref|target|ground[\W_]*truth|gt)(?![^\W\d_])", re.IGNORECASE)
# These count only in the names of folders that hold the files themselves: objects/cow/ is the folder of one object.
_REFERENCES = re.compile(r"(originals|references|targets|objects)", re.IGNORECASE)
# Meshes of at least this part of the reference's triangles may be no versions of it.
_AS_FINE = 0.8
# The size of a mesh at an end of its name: cow_500, cow-1k7, cow 20.5, 500_cow.
_NUMBER = r"\d+(?:[.,]\d+)?(?:[kKmM]\d*)?"
_SIZE = re.compile(rf"^{_NUMBER}(?![^\W_])|{_NUMBER}$")
_LONGEST_NAME = 100
# Characters between the parts of a name.
_BETWEEN = " _-."
# More families, or objects on a line, would hide what comes next.
_MOST_LINES, _MOST_OBJECTS = 10, 6
# What the optional decimated family has, as fractions of the triangles of the reference.
_FRACTIONS = (16, 8, 4, 2)
_FEWEST_TRIANGLES = 4

# The pieces of a study file by their names. Values are filled in as JSON spells them, which TOML shares.
_PIECES = tomllib.loads(Path(__file__).with_name("draft.toml").read_text("utf-8"))
# The files of each object and family; a study of one object calls that "".
_Families = Mapping[tuple[str, str], Sequence[PurePosixPath]]


@dataclass(frozen=True)
class StudyDraft(Shown):
    """A study file that was written for a folder of meshes; ``print(draft)`` tells what it holds and what to do next.

    Attributes:
        path: Path of the file.
        summary: Lines on the reference, and on the meshes of each family or object.
        left_out: Reason for each mesh file of the folder that the study does not name, by path.
        doubtful: Question for each small file that looks as if its reference were another one, by path.

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
    doubtful: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        file, more = shlex.quote(str(self.path)), len(self.summary) - _MOST_LINES
        families = [*self.summary[:_MOST_LINES], *([f"and {more} more"] if more > 0 else [])]
        named = reasons("left out", self.left_out), reasons("doubtful", together(self.doubtful))
        left_out = [f"{name}: {text}" for name, text in chain(*named)]
        following = [f"next: sobolev-batch plan {file}", f"      sobolev-batch run {file}"]
        return "\n".join(map(visible, [f"{self.path}: {families[0]}", *families[1:], *left_out, *following]))


def init_study(folder: str | Path = ".", output: str | Path = "study.toml") -> StudyDraft:
    """Write a study file for a folder of meshes, which runs as it is.

    The reference is the mesh that is called original, reference, target or ground truth, or else the one with the most
    triangles. Each folder is a family; the meshes of a single folder are families by their names without the number at
    the end. Where several files are called references and others belong to them by name, the study has several
    objects, and so it has where the names of files begin as those of finer ones, in any folder, or where the finest
    files of all folders have one name. References alone are compared with decimated versions of themselves. Files are
    looked at, and only small ones are read.

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
    folder, output = path_of(folder), path_of(output)
    if output.exists() or output.is_symlink():
        # Before files are looked at, which may take a while.
        raise StudyError(f"{output} exists already; name another file, or move it away")
    if not folder.is_dir():
        raise StudyError(f"{folder}: there is no such folder; name one with mesh files")
    # Links are followed, as the system follows them from the study file on.
    base = output.parent.resolve()
    below = PurePosixPath(Path(os.path.relpath(folder.resolve(), base)).as_posix())
    if problem := _path_problem(str(below)):
        raise StudyError(f"{folder}: its path cannot be in a study file: {problem}; rename it")
    sizes, extents, left_out = _look_at(folder)
    are_all = _REFERENCES.fullmatch(folder.resolve().name) is not None
    references = _references(sizes, are_all=are_all) or _references(sizes) or {"": _reference(folder, sizes, left_out)}
    families = _families(sizes, references)
    used = {*references.values(), *chain.from_iterable(families.values())}
    doubts = {
        str(path): doubt
        for (name, _), paths in families.items()
        for path in paths
        if {path, references[name]} <= extents.keys()
        if (doubt := placement_doubt(extents[path], extents[references[name]]))
    }
    if families and "" not in references:
        sections, summary = _several_objects(references, families, below, base)
    else:
        sections, summary = _one_reference(references, families, sizes, below)
    lacks = "no other mesh belongs to it by name, nor it to one"
    left_out |= {str(path): lacks for path in sizes if path not in used}
    name = _json(_free_name(folder.resolve().name, fallback="study"))
    text = _filled("study", name=name, sections="".join(f"\n{section}" for section in sections))
    study = Study.from_table(tomllib.loads(text), folder=base)
    if "" in references:
        # A study that cannot list its meshes is none to write down.
        len(study.object.members)
    with written(output, "the study", StudyError), output.open("x", encoding="utf-8", newline="\n") as file:
        file.write(text)
    return StudyDraft(output, summary, left_out, doubts)


def _look_at(folder: Path) -> tuple[dict[PurePosixPath, int], dict[PurePosixPath, Extent], dict[str, str]]:
    """Return the triangles of each mesh file that a study can name, extents of small ones, and reasons for others.

    Paths below the folder are in their natural order. Hidden files, stores, the meshes made beside these, and links to
    folders are left out. Small files are read as a whole, up to some bytes together.
    """
    found: list[str] = []
    for parent, folders, files in os.walk(folder):
        shown = (name for name in folders if not name.startswith("."))
        folders[:] = [name for name in shown if not name.endswith((".zarr", MADE_MESHES))]
        meshes = (Path(parent, name) for name in files if not name.startswith("."))
        found += [path.relative_to(folder).as_posix() for path in meshes if is_mesh_name(path)]
        if len(found) > MOST_MESHES:
            raise StudyError(f"{folder} has more than {MOST_MESHES} mesh files; name a folder with fewer")
    sizes, extents = dict[PurePosixPath, int](), dict[PurePosixPath, Extent]()
    left_out, names, left = dict[str, str](), dict[str, str](), _MOST_BYTES
    for below in sorted(found, key=natural_key):
        other = names.setdefault(caseless_key(below), below)
        try:
            if other != below:
                raise MeshError(f"its name differs from that of {quoted(other)} only in case or accents; rename one")
            if problem := _path_problem(below):
                raise MeshError(f"its name cannot be in a study file: {problem}; rename it")
            (triangles, _), size = expected_size(folder / below), (folder / below).stat().st_size
            # A file without an expected size is of another format, damaged or empty.
            if size <= left or not triangles:
                left -= size
                mesh = read_mesh(folder / below)
                triangles, extents[PurePosixPath(below)] = len(mesh.triangles), mesh.extent
            sizes[PurePosixPath(below)] = triangles
        except (MeshError, OSError) as error:
            left_out[below] = str(error).removeprefix(f"{folder / below}: ")
    return sizes, extents, left_out


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
    # The shortest path comes first among equals: original.ply before original_2.ply.
    for path in sorted(sizes, key=lambda path: (not _is_called_reference(path), -sizes[path], len(str(path)))):
        with suppress(MeshError):
            read_mesh(folder / path)
            return path
    examples = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
    raise StudyError(f"{folder} holds no mesh file that can be read{': ' * bool(examples)}{examples}; name another")


def _free_name(wanted: str, taken: Iterable[str] = (), fallback: str = "meshes") -> str:
    """Return a name for a family that no other has."""
    visible = "".join(c if c.isprintable() and c not in "/\\" else " " for c in wanted)
    name = " ".join(visible.split())[: _LONGEST_NAME - 10].strip() or fallback
    known = {caseless_key(other) for other in (*taken, REFERENCE_LABEL)}
    numbered = [name, *(f"{name} {number}" for number in range(2, len(known) + 3))]
    return next(candidate for candidate in numbered if caseless_key(candidate) not in known)


def _references(sizes: Mapping[PurePosixPath, int], *, are_all: bool = False) -> dict[str, PurePosixPath]:
    """Return the references by their objects; none where all files are of one object.

    There are several objects if several files are called references, as all are in a folder that is called so, of which
    some have files of their names, or where there are no other files at all.
    """
    called = [path for path in sizes if are_all or _is_called_reference(path)]
    references = {_object_of(path): path for path in called} or _continued(sizes) or _of_folders(sizes)
    owners = {name for name, _ in _families(sizes, references)}
    are_different = 2 <= len({*map(caseless_key, references)}) == len(called or references)
    is_refused = any(name_problem(name, _LONGEST_NAME, RESERVED) or name.startswith((".", "__")) for name in references)
    if not are_different or is_refused:
        return {}
    # Names that others continue, as cow and cow_500, are those of one object.
    is_continued = any(re.match(rf"{re.escape(name)}[\W_]", own) for own in references for name in references)
    is_alone = len(called) == len(sizes) and not is_continued
    return references if is_alone else {name: path for name, path in references.items() if name in owners}


def _of_folders(sizes: Mapping[PurePosixPath, int]) -> dict[str, PurePosixPath]:
    """Return the finest file of each folder, where all are of one name without a size, and much finer than the others.

    Folders of methods have the sizes of their meshes in the names of these, or a reference beside them.
    """
    finest = {path.parent: path for path in sorted(sizes, key=lambda path: sizes[path])}
    names, references = {mesh_stem(path) for path in finest.values()}, {*finest.values()}
    are_finer = all(path in references or 2 * size <= sizes[finest[path.parent]] for path, size in sizes.items())
    is_paired = len(names) == 1 and not any(map(_SIZE.search, names)) and len(sizes) >= 2 * len(finest)
    return {folder.name: path for folder, path in finest.items()} if are_finer and is_paired else {}


def _continued(sizes: Mapping[PurePosixPath, int]) -> dict[str, PurePosixPath]:
    """Return the files whose names others continue or have, in any folder, with fewer triangles.

    There are none if the others of most lack, as outputs that failed, or that of the finest file.
    """
    stems = {path: mesh_stem(path) for path in sorted(sizes, key=lambda path: sizes[path])}
    finest = {caseless_key(stem): path for path, stem in stems.items()}
    owners = {}
    for path, size in sizes.items():
        stem = stems[path]
        known = ((name, finest.get(caseless_key(name))) for name, _ in _names_in(path) if name != stem)
        # A name that does not begin with that of a finer mesh may be of another object.
        found = (one for name, one in known if one and (stem.startswith(name) or sizes[one] > size))
        owners[path] = owner = next(found, finest.get(caseless_key(stem), path))
        # Files of one name may be of two methods, unless one is much finer.
        if path != owner and size * (1 + (stems[owner] == stem)) > sizes[owner]:
            return {}
    own = {stems[path]: path for path, owner in owners.items() if path == owner}
    followed = {owner for path, owner in owners.items() if path != owner}
    if not followed <= {*own.values()} or 2 * len(followed) <= len(own):
        return {}
    is_finest = max(sizes[path] for path in followed) == max(sizes.values())
    return {name: path for name, path in own.items() if path in followed} if is_finest else {}


def _families(paths: Iterable[PurePosixPath], references: Mapping[str, PurePosixPath]) -> _Families:
    """Return the files of each object and family, which is that of their folder or of their name."""
    known, taken = {caseless_key(name): name for name in references}, {*references.values()}
    # The object of each file that has one, and what its name says beside that of the object.
    owned: dict[PurePosixPath, tuple[str, str]] = {}
    for path in paths:
        names = ((known.get(caseless_key(name)), rest) for name, rest in _names_in(path) if path not in taken)
        if first := next(((name, rest) for name, rest in names if name is not None), None):
            owned[path] = first
    # Objects and sizes have folders of their own, which say nothing of families.
    own = {name: {*map(caseless_key, (name, *(one.parent.parts if name else ())))} for name, one in references.items()}
    folders = {
        path: [part for part in path.parent.parts if not _SIZE.fullmatch(part) and caseless_key(part) not in own[name]]
        for path, (name, _) in owned.items()
    }
    shared = sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*folders.values(), strict=False)))
    wanted = {}
    for path, (_, rest) in owned.items():
        # With slashes, or the families of a/b and "a b" would be one.
        named = _SIZE.sub("", rest).strip(_BETWEEN)
        # Numbers alone, as those of dates, are no name.
        named = named if any(map(str.isalpha, named)) else ""
        wanted[path] = "/".join(folders[path][shared:]) or named or "".join(folders[path][-1:])
    families: dict[tuple[str, str], list[PurePosixPath]] = {}
    counts, free = Counter(wanted.values()), dict[str, str]()
    for path, family in wanted.items():
        # Meshes of one object that are alone, in no folder of their own, are a family together.
        is_alone = not owned[path][0] and not folders[path][shared:] and counts[family] == 1
        family = "" if is_alone else family
        if family not in free:
            free[family] = _free_name(family, free.values())
        families.setdefault((owned[path][0], free[family]), []).append(path)
    return families


def _object_of(reference: PurePosixPath) -> str:
    """Return the name of the object of a reference: cow of objects/cow.ply, cow/original.ply, cow_original.ply."""
    rest = _REFERENCE.sub("", mesh_stem(reference)).strip(_BETWEEN)
    own = [part for part in reference.parent.parts if not _REFERENCE.search(part) and not _REFERENCES.fullmatch(part)]
    return rest or "".join(own[-1:])


def _names_in(path: PurePosixPath) -> Iterator[tuple[str, str]]:
    """Yield names of objects that a file may belong to, and what its stem says beside them.

    cow_big_500 is of cow_big, not of cow: beginnings of the stem come first, the longest before all, then folders,
    then other words of the stem, as cow of quick_cow_500.
    """
    stem = mesh_stem(path)
    starts = [i for i in range(1, len(stem)) if stem[i].isalnum() and not stem[i - 1].isalnum()]
    ends = [i for i in range(len(stem), 0, -1) if not stem[i : i + 1].isalnum()]
    for end in ends:
        yield stem[:end], stem[end:]
    for part in path.parent.parts:
        yield part, stem
    for start, end in sorted(product(starts, ends), key=lambda one: one[0] - one[1]):
        if start < end:
            yield stem[start:end], stem[:start] + stem[end:]
    yield "", stem


def _one_reference(
    references: Mapping[str, PurePosixPath],
    families: _Families,
    sizes: Mapping[PurePosixPath, int],
    folder: PurePosixPath,
) -> tuple[list[str], tuple[str, ...]]:
    """Return the sections of a study of one object, or of originals alone, which decimates them; and what they hold."""
    shown = {str(folder / one).replace(name or OBJECT, OBJECT) for name, one in references.items()}
    path, triangles = shown.pop(), min(sizes[one] for one in references.values())
    counts = [count for part in _FRACTIONS if (count := triangles // part) >= _FEWEST_TRIANGLES]
    if (reference := references.get("")) is not None:
        too_small = f"too small to decimate ({triangles} triangles)"
        problem = f"{reference} is the only mesh that can be read, and {too_small}; add other meshes"
        remark = "its name says so" if _is_called_reference(reference) else "the mesh with the most triangles"
        summary = [f"reference {path}, {triangles:,} triangles"]
    else:
        names, example = few_of([*map(str, references.values())]), f"METHOD/{next(iter(references))}_500.ply"
        problem = f"there are originals alone ({names}); add meshes with their names, such as {example}"
        remark = "new files of this kind are objects too"
        summary = [f"{_objects_text(references)}, each compared with decimated versions of itself"]
    if shown or not (families or counts):
        raise StudyError(problem)
    sections = [_filled("reference", remark=remark, path=_json(path))]
    for (_, family), members in families.items():
        ends = dict.fromkeys(f"{end(sizes[member] for member in members):,}" for end in (min, max))
        size = f"{_count(len(members))}, {' to '.join(ends)} triangles"
        paths = "".join(f"    {_json(str(folder / member))},\n" for member in members)
        sections.append(_filled("family", name=_json(family), paths=paths, size=size))
        summary.append(f"family {family}: {size}")
    others = [path for paths in families.values() for path in paths]
    if others and all(sizes[path] >= _AS_FINE * triangles or _is_called_reference(path) for path in others):
        summary.append("are these objects of their own? if so, move them into a folder called originals, and init that")
    if counts:
        decimated, remark = _filled("decimated", counts=counts), "remove the # in front of these lines"
        sections.append(f"# Compare with decimation: {remark}.\n{indent(decimated, '# ')}" if families else decimated)
    return sections, tuple(summary)


def _several_objects(
    references: Mapping[str, PurePosixPath], families: _Families, folder: PurePosixPath, base: Path
) -> tuple[list[str], tuple[str, ...]]:
    """Return the sections of a study of several objects, by patterns or as a list of meshes, and what they hold."""
    listed = [(name, REFERENCE_LABEL, str(folder / path)) for name, path in references.items()]
    listed += [(name, method, str(folder / path)) for (name, method), paths in families.items() for path in paths]
    of_meshes = listed[len(references) :]
    counts = Counter(method for _, method, _ in of_meshes)
    methods = (f"method {method}: {_count(count)}" for method, count in counts.items())
    path, *others = {path.replace(name, OBJECT) for name, _, path in listed[: len(references)]}
    patterns = "".join(f"    {_json(one)},\n" for one in dict.fromkeys(starmap(_pattern, of_meshes)))
    remark = "new files of these kinds count too"
    sections = [
        _filled("reference", remark=remark, path=_json(path)),
        _filled("family", name=_json(METHOD), paths=patterns, size=_count(len(of_meshes))),
    ]
    if others or not _names_these(sections, listed, base):
        values = (dict(zip(("name", "method", "path"), map(_json, one), strict=True)) for one in listed)
        sections = [_filled("objects", meshes="".join(_filled("mesh", **each) for each in values))]
    return sections, (_objects_text(references), *methods)


def _pattern(name: str, method: str, path: str) -> str:
    """Return the path of a mesh with placeholders for its object and its method, and stars for numbers."""
    for text, placeholder in ((re.escape(name), OBJECT), (re.escape(method), METHOD), (_NUMBER, "*")):
        path = re.sub(rf"(?<![^\W_]){text}(?![^\W_])", placeholder, path)
    return path


def _names_these(sections: Sequence[str], listed: Iterable[tuple[str, str, str]], base: Path) -> bool:
    """Return whether sections of a study name these meshes of objects and methods, and no others."""
    with suppress(StudyError, MeshError):
        text = _filled("study", name=_json("patterns"), sections="\n".join(sections))
        study = Study.from_table(tomllib.loads(text), folder=base)
        members = ((name, *member) for name, one in study.objects.items() for member in one.members.values())
        found = ((name, family, member.path) for name, family, member in members if isinstance(member, FileMember))
        return sorted(found) == sorted((name, method, (base / path).absolute()) for name, method, path in listed)
    return False


def _objects_text(names: Iterable[str]) -> str:
    shown = [*names]
    return f"{len(shown)} object{'s' * (len(shown) != 1)}: {few_of(shown, _MOST_OBJECTS)}"


def _filled(piece: str, **values: object) -> str:
    return Template(_PIECES[piece]).substitute(values)


def _json(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _count(number: int) -> str:
    return f"{number} mesh{'es' * (number != 1)}"
