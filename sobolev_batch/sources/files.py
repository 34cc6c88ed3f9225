"""The source `files`: meshes from the file system, by path, by glob or in a list.

A list is a CSV file, or tables of a study. Each mesh has a ``path``, relative to the CSV file or to the study file. It
may have a ``name`` and a ``time``. All else are its metadata, numbers or texts, which the tables of a store repeat.
"""

import hashlib
import os
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from glob import has_magic
from importlib.metadata import PackageNotFoundError, distribution
from io import BufferedReader
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import pandas as pd
from pydantic import BeforeValidator, Field, model_validator

from sobolev_batch.errors import MeshError, StudyError
from sobolev_batch.geometry.formats.by_name import mesh_format, mesh_stem
from sobolev_batch.geometry.formats.parsing import checked_length, open_regular
from sobolev_batch.geometry.formats.readers import expected_size, files_beside, read_mesh_by
from sobolev_batch.geometry.surface import Surface, is_finite_number
from sobolev_batch.sources.names import (
    caseless_key,
    duplicate_names,
    label_problem,
    name_problem,
    natural_key,
    node_problem,
    numbers_in,
    quoted,
)
from sobolev_batch.sources.registry import ExpectedSize, Fingerprint, Member, Source, at_most, checked_times

MOST_MESHES = 100_000
_LONGEST_TEXT = 1000
_LARGEST_FILE_BYTES = 64 << 20
# What the file system says of a file.
_State = tuple[str | int, ...]
# Digests of the last files that were read; a file that was changed within this time may be changed again without a
# trace in the file system. A plan reads many files, and asks for their digests afterwards.
_digests: dict[_State, str] = {}
_SETTLED_NS, _MOST_DIGESTS = 2 * 10**9, 10_000
# What a list says of a mesh: its path, and perhaps a name, a time and metadata.
MeshTable = dict[str, Any]
# Columns of names, which may look like numbers.
_TEXTS = ("path", "name", "object", "method")
_EXAMPLE = '{ path = "a.ply", method_seconds = 3.5 }'
_Text = Annotated[str, Field(min_length=1)]
_Paths = Annotated[tuple[_Text, ...], Field(min_length=1, strict=False), at_most(MOST_MESHES)]


def checked_list(value: object) -> str | tuple[MeshTable, ...] | None:
    """Return the key ``meshes`` of a study, path of a CSV file or list of meshes; ValueError where it is neither."""
    if value is None or (isinstance(value, str) and value):
        return value
    if not isinstance(value, list | tuple) or not value or not all(isinstance(table, Mapping) for table in value):
        raise ValueError(f'must be the path of a CSV file, such as "meshes.csv", or a list of tables like {_EXAMPLE}')
    return _listed(value)


def read_mesh_list(path: Path) -> tuple[MeshTable, ...]:
    """Return the meshes that a CSV file lists below the names of its columns; StudyError where it does not."""
    this = f"meshes: the list {quoted(path.name)}"
    try:
        with open_regular(path) as file:
            length = os.fstat(file.fileno()).st_size
            if length > _LARGEST_FILE_BYTES:
                raise StudyError(f"a list has at most {_LARGEST_FILE_BYTES} bytes, found {length}")
            # As texts: a name such as 007 stays what it is. Without a header pandas refuses lines that are longer than
            # the first one, and gives no other name to a repeated column.
            cells = pd.read_csv(
                file, header=None, dtype=str, keep_default_na=False, encoding="utf-8-sig", skipinitialspace=True
            )
    except (OSError, ValueError) as error:
        raise StudyError(f"{this} cannot be read: {str(error).strip()}") from error
    header = cells.iloc[0].fillna("").str.strip()
    frame = cells.iloc[1:].fillna("").set_axis(header, axis=1)
    if len(repeated := header[header.duplicated()]):
        raise StudyError(f"{this} has the column {quoted(repeated.iloc[0])} twice")
    if "path" not in frame or frame.empty:
        found = f"{len(frame)} lines of the columns {quoted(list(frame.columns))}"
        raise StudyError(f"{this} needs a column path and a line for each mesh; found {found}")
    for key in frame.columns.difference(_TEXTS):
        numbers = pd.to_numeric(frame[key].str.strip(), errors="coerce")
        is_number = numbers.notna() | (frame[key].str.strip() == "")
        # A column is one of numbers only if all that it says are; times that are none are named one by one.
        if is_number.all() or key == "time":
            frame[key] = numbers.astype(object).where(is_number, frame[key])
    try:
        return _listed(frame.to_dict(orient="records"))
    except ValueError as error:
        raise StudyError(f"{this}: {error}") from error


def number_as_text(number: float) -> str:
    """Return a number that stands for a name, with all its digits.

    >>> number_as_text(7.0), number_as_text(1234567), number_as_text(0.5)
    ('7', '1234567', '0.5')
    """
    return str(int(number)) if float(number).is_integer() else repr(float(number))


def _listed(tables: Any) -> tuple[MeshTable, ...]:
    if len(tables) > MOST_MESHES:
        raise ValueError(f"at most {MOST_MESHES} meshes are allowed, found {len(tables)}")
    return tuple(map(_checked_table, tables))


def _checked_table(table: Mapping[str, Any]) -> MeshTable:
    """Return the table of a mesh without what says nothing: empty texts and NaN."""
    known = {key: value for key, value in table.items() if value not in (None, "") and value == value}
    path, name, time = known.pop("path", None), known.pop("name", None), known.pop("time", None)
    if not isinstance(path, str):
        raise ValueError(f"each mesh needs a path, as in {_EXAMPLE}; found {quoted(dict(table))}")
    checked: MeshTable = {"path": _checked_path(path)}
    if name is not None:
        checked["name"] = number_as_text(name) if is_finite_number(name) else name
        problem = label_problem(checked["name"]) if isinstance(checked["name"], str) else "it is no text"
        if problem is not None:
            raise ValueError(f"{quoted(path)} has the name {quoted(name)}, which is no label: {problem}")
    if time is not None:
        if not is_finite_number(time):
            raise ValueError(f"{quoted(path)} has the time {quoted(time)}; a time is a number")
        checked["time"] = float(time)
    for key, value in known.items():
        if (problem := node_problem(key)) is not None:
            raise ValueError(f"{quoted(key)} cannot name metadata: {problem}")
        if isinstance(value, Real) and is_finite_number(value):
            checked[key] = float(value)
        elif isinstance(value, str) and name_problem(value, _LONGEST_TEXT) is None:
            checked[key] = value
        else:
            raise ValueError(f"{key} of {quoted(path)} must be a number or a line of text, found {quoted(value)}")
    return checked


def _checked_path(path: str) -> str:
    if "\0" in path:
        raise ValueError(f"no file can have the name {quoted(path)}, which holds the character NUL")
    if "://" in path:
        raise ValueError(f"{quoted(path)} is a URL, and meshes are read from files; fetch it, and give its path")
    return path


def _checked_times(value: Any) -> Any:
    if value is None or value == "names":
        return value
    if isinstance(value, str):
        raise ValueError('must be a list of numbers, or "names" for the numbers in the names of the files')
    return checked_times(value)


class FileSource(Source):
    """Mesh files: their paths and globs, those of an installed distribution, or a list of what is known of them.

    The file of a path must exist when its mesh is computed; a glob must match a file at once. Files of a distribution
    are those that it recorded at its installation, without wildcards; it is not imported. Times make states of one
    mesh that moves: one for each file, in the order of the numbers in their names, or "names" for the last of these.
    """

    paths: _Paths | None = None
    meshes: Annotated[str | tuple[MeshTable, ...] | None, BeforeValidator(checked_list)] = None
    distribution: _Text | None = None
    times: Annotated[tuple[float, ...] | Literal["names"] | None, BeforeValidator(_checked_times)] = None

    @model_validator(mode="after")
    def _paths_or_meshes(self) -> Self:
        if (self.paths is None) == (self.meshes is None):
            raise ValueError('either paths, such as ["a.ply", "*.obj"], or a list of meshes is needed, and not both')
        if self.meshes is not None and (self.distribution is not None or self.times is not None):
            raise ValueError("distribution and times belong to paths; a list of meshes gives each its time")
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per file, sorted by path or time, or as listed, named by the stem where that is unique."""
        if self.meshes is not None:
            return _listed_members(self.meshes, folder)
        if self.distribution is not None:
            found = [_recorded_file(self.distribution, path) for path in self.paths or ()]
        else:
            found = [match for path in self.paths or () for match in matching_files(folder, path)]
        paths = sorted(set(found))
        times = dict.fromkeys(paths) if self.times is None else _times(paths, self.times)
        names = dict(zip(paths, names_of_files(paths), strict=True))
        # Absolute, since a worker may have been started in another folder.
        return tuple(FileMember(names[path], -1, path.absolute(), time=time) for path, time in times.items())


@dataclass(frozen=True)
class FileMember(Member):
    """A mesh file."""

    path: Path
    is_quickly_loaded: ClassVar[bool] = True

    def load(self) -> Surface:
        """Read the file; its digest is then known without reading it again."""
        return read_mesh_by(self.path, _read_once)

    def fingerprint(self) -> Fingerprint:
        """Return the format, and the digest of the file and of those beside it that it needs."""
        own = {"file": file_digest(self.path), "format": mesh_format(self.path)}
        beside = [file_digest(path) for path in files_beside(self.path)]
        return {**own, "beside": beside} if beside else own

    def expected_size(self) -> ExpectedSize:
        """Return the size that the header announces, or that the length of the file suggests."""
        return ExpectedSize(*expected_size(self.path))


def _listed_members(meshes: str | tuple[MeshTable, ...], folder: Path) -> tuple[Member, ...]:
    """Return one member for each mesh of a list, by the name that it gives or the stem of its file."""
    if isinstance(meshes, str):
        folder, meshes = (folder / meshes).parent, read_mesh_list(folder / meshes)
    paths = [folder / mesh["path"] for mesh in meshes]
    unnamed = list(dict.fromkeys(path for path, mesh in zip(paths, meshes, strict=True) if "name" not in mesh))
    stems = dict(zip(unnamed, names_of_files(unnamed), strict=True))
    names = [mesh.get("name") or stems[path] for path, mesh in zip(paths, meshes, strict=True)]
    if repeated := duplicate_names(names):
        raise StudyError(f"meshes: several are named {quoted(repeated[0][0])}; give each a name of its own")
    members = []
    for name, path, mesh in zip(names, paths, meshes, strict=True):
        metadata = tuple((key, value) for key, value in mesh.items() if key not in ("path", "name", "time"))
        members.append(FileMember(name, -1, path.absolute(), time=mesh.get("time"), metadata=metadata))
    return tuple(members)


def _recorded_file(name: str, path: str) -> Path:
    """Return the path of a file that an installed distribution recorded."""
    try:
        recorded = distribution(name).files or []
    except PackageNotFoundError as error:
        raise StudyError(f"the distribution {name!r} is not installed; install it, as by pip install {name}") from error
    for file in recorded:
        if file.as_posix() == path:
            return Path(str(file.locate()))
    raise StudyError(f"the distribution {name!r} {distribution(name).version} contains no file {path!r}")


def matching_files(folder: Path, path: str) -> list[Path]:
    """Return the files that a path or a glob of ``**``, ``*``, ``?`` and ``[...]`` names; StudyError where none does.

    Hidden files match only where a part of the glob begins with a dot; ``**`` follows no links to folders.
    """
    try:
        _checked_path(path)
    except ValueError as error:
        raise StudyError(f"paths: {error}") from error
    # A file may have wildcard characters in its name; an existing one is meant.
    if not has_magic(path) or os.path.isfile(folder / path):
        return [folder / path]
    parts, glob = Path(path).parts, quoted(path, 300)
    first = next(place for place, part in enumerate(parts) if has_magic(part))
    base, wild = folder.joinpath(*parts[:first]), parts[first:]
    try:
        if any("**" in part and part != "**" for part in wild):
            raise ValueError("Invalid pattern: ** is a whole part of a path")  # Python 3.13 takes it for *
        # At the end, ** stands for folders alone.
        found = [*base.glob("/".join([*wild, "*"] if wild[-1] == "**" else wild))]
    except ValueError as error:
        raise StudyError(f"paths: the glob {glob} is none: {error}") from error
    if not any(part.startswith(".") for part in wild):
        found = [file for file in found if not any(part.startswith(".") for part in file.relative_to(base).parts)]
    if not (files := [file for file in dict.fromkeys(found) if file.is_file()]):
        raise StudyError(f"paths: the glob {glob} matches no file below {base}; correct it, or put files there")
    return files


def _times(paths: list[Path], given: tuple[float, ...] | Literal["names"]) -> dict[Path, float]:
    if given == "names":
        times = {path: _last_number(path) for path in paths}
    elif len(given) == len(paths):
        times = dict(zip(sorted(paths, key=lambda path: natural_key(path.as_posix())), given, strict=True))
    else:
        raise StudyError(f"times: {len(given)} times are given for {len(paths)} files; give one for each")
    if repeated := [time for time, count in Counter(times.values()).items() if count > 1]:
        raise StudyError(f"times: several files have the time {repeated[0]:g}; each state needs a time of its own")
    return dict(sorted(times.items(), key=lambda item: item[1]))


def _last_number(path: Path) -> float:
    if not (numbers := numbers_in(mesh_stem(path))):
        raise StudyError(f"times: the name of the file {quoted(path.name)} has no number; list the times instead")
    return numbers[-1]


def names_of_files(paths: list[Path]) -> list[str]:
    """Return stems; file names where stems collide, and whole paths where these collide with any other name."""
    names = list(map(mesh_stem, paths))
    for longer in ([path.name for path in paths], [path.as_posix() for path in paths]):
        counts = Counter(map(caseless_key, names))
        names = [name if counts[caseless_key(name)] == 1 else other for name, other in zip(names, longer, strict=True)]
    for path, name in zip(paths, names, strict=True):
        if (problem := label_problem(name)) is not None:
            raise StudyError(f"paths: the name of the file {quoted(path.name)} is no label: {problem}; rename the file")
    if duplicates := duplicate_names(names):
        raise StudyError(
            f"paths: the files {' and '.join(map(quoted, duplicates[0][:3]))} have names that differ only in case or "
            "in the encoding of accents; rename one"
        )
    return names


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, read again only if it has changed; MeshError where it cannot be read."""
    try:
        with open_regular(path) as file:
            checked_length(file)
            state = _settled_state(file)
            return _digests.get(state) or _remembered(state, hashlib.file_digest(file, "sha256").hexdigest())
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _read_once(file: BufferedReader, length: int) -> bytes:
    state, data = _settled_state(file), file.read(length)
    _remembered(state, hashlib.sha256(data).hexdigest())
    return data


def _settled_state(file: BufferedReader) -> _State:
    """Return what the file system says of an open file; nothing where a change of the file might not show in it."""
    now, status = time.time_ns(), os.fstat(file.fileno())
    times = status.st_mtime_ns, status.st_ctime_ns
    is_settled = max(times) + _SETTLED_NS < now
    return (str(file.name), status.st_dev, status.st_ino, status.st_size, *times) if is_settled else ()


def _remembered(state: _State, digest: str) -> str:
    if len(_digests) >= _MOST_DIGESTS:
        _digests.clear()
    if state:
        _digests[state] = digest
    return digest
