"""The sources `command` and `function`: meshes that a program, or a function of yours, makes of another mesh.

Such a mesh may take long, so it is kept in a `MeshCache`. Nothing runs without one that permits it: a study file may
come from somebody else.
"""

import hashlib
import inspect
import re
import shlex
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Self

import pandas as pd
from pydantic import BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from sobolev_batch.errors import MeshError, StudyError, one_line, refused_by_pydantic
from sobolev_batch.geometry.formats.conversion import as_mesh
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.parameters import byte_count
from sobolev_batch.sources.files import file_digest, number_as_text
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import label_problem, quoted
from sobolev_batch.sources.programs import INPUT, OUTPUT, PLACEHOLDER, Cost, Made, run_command
from sobolev_batch.sources.registry import (
    MOST_ENTRIES,
    ExpectedSize,
    Fingerprint,
    KeepingSource,
    Member,
    NestedSource,
    load_mesh,
    single_member,
)

Parameter = str | int | float | bool
# A function that makes a mesh of another one, what a fingerprint holds of it besides its parameters and its version,
# and files that it reads besides, by their names in a command.
Remesher = tuple[Callable[[Mesh], Made], dict[str, Any], dict[str, Path]]

# The placeholder for the folder of the study.
_FOLDER = "folder"


def _seconds(value: object) -> float:
    """Return a time, given in seconds or as a text such as "10 min"."""
    with suppress(ValueError):
        try:
            # Pandas would take a text without a unit for nanoseconds.
            seconds = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            seconds = pd.Timedelta(str(value)).total_seconds()
        if not isinstance(value, bool) and 0 < seconds < float("inf"):
            return float(seconds)
    raise ValueError("must be a number of seconds, or a time such as '10 min' or '2 h'")


def _bytes(value: object) -> int:
    with refused_by_pydantic():
        return byte_count(value)  # type: ignore[arg-type]


def _file_suffix(value: object) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"\.[A-Za-z0-9]+", value):
        raise ValueError("must be the suffix of a mesh format, such as '.ply'")
    return value.lower()


FileSuffix = Annotated[str, BeforeValidator(_file_suffix)]
Words = Annotated[tuple[str, ...], Field(min_length=1, strict=False)]


class RemesherSource(NestedSource, KeepingSource):
    """Meshes that something of yours makes of one other mesh.

    Keys that are not listed here are its parameters: numbers, texts or truth values. A list of them is swept: each
    value makes a mesh, and several lists make one for each combination.
    """

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters by name; a list stands for its values."""
        return dict(self.model_extra or {})

    @model_validator(mode="after")
    def _check_parameters(self) -> Self:
        count = 1
        for name, value in self.parameters.items():
            values = value if isinstance(value, list | tuple) else [value]
            if not values or not all(isinstance(entry, Parameter) for entry in values):
                allowed = "a number, a text, true, false or a list of them"
                raise ValueError(f"{name} must be {allowed}, found {quoted(value)}")
            count *= len(values)
        if count > MOST_ENTRIES:
            raise ValueError(f"at most {MOST_ENTRIES} meshes are allowed, and its lists make {count}")
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each combination of parameters, in the order of the lists."""
        original, version = single_member(self.mesh, folder), self._found_version(folder)
        members = []
        for name, parameters in self._swept(original.name):
            make, settings, files = self._remesher(parameters, folder)
            known = parameters.items()
            metadata = tuple((key, _as_text(x) if isinstance(x, bool | str) else float(x)) for key, x in known)
            identity = {"remesher": {**settings, "parameters": parameters}, "version": version}
            members.append(RemeshedMember(name, -1, make, identity, original, files, self._cache, metadata=metadata))
        return tuple(members)

    def _swept(self, alone: str) -> Iterator[tuple[str, dict[str, Parameter]]]:
        lists = {name: value for name, value in self.parameters.items() if isinstance(value, list | tuple)}
        for values in product(*lists.values()):
            texts = list(map(_as_text, values))
            named = [f"{key}={text}" for key, text in zip(lists, texts, strict=True)]
            name = texts[0] if len(texts) == 1 else ",".join(named) or alone
            if (problem := label_problem(name)) is not None:
                raise StudyError(f"the parameters {quoted(name)} are no label: {problem}")
            yield name, {**self.parameters, **dict(zip(lists, values, strict=True))}

    @abstractmethod
    def _remesher(self, parameters: dict[str, Parameter], folder: Path) -> Remesher:
        """Return what makes the mesh of some parameters."""

    @abstractmethod
    def _found_version(self, folder: Path) -> str | None:
        """Return the version of the remesher."""


class CommandSource(RemesherSource):
    """Meshes that a program makes of one other mesh.

    The program gets a folder of its own, and no shell. ``{input}`` and ``{output}`` in the command stand for its files,
    ``{folder}`` for the folder of the study, and ``{NAME}`` for a parameter. docs/remeshers.md has the keys.
    """

    command: Words
    input: FileSuffix = ".ply"
    output: FileSuffix = ".ply"
    timeout: Annotated[float, BeforeValidator(_seconds)] = 3600.0
    largest_output: Annotated[int, BeforeValidator(_bytes)] = 4_000_000_000
    version: Words | None = None

    @property
    def commands(self) -> tuple[str, ...]:
        """The command and that of the version, as a shell would have them; and those of other sources."""
        return (*map(shlex.join, filter(None, (self.command, self.version))), *super().commands)

    @model_validator(mode="after")
    def _check_command(self) -> Self:
        asked = {name for word in self.command for name in PLACEHOLDER.findall(word)}
        known = {INPUT, OUTPUT, _FOLDER, *self.parameters}
        if unknown := sorted(asked - known):
            raise ValueError(f"the command has {{{unknown[0]}}}, and no parameter has this name")
        if unused := sorted(known - asked - {_FOLDER, INPUT, OUTPUT}):
            name, keys = unused[0], ", ".join(type(self).model_fields)
            raise ValueError(f"{name} is unknown: it is no key ({keys}), and the command has no {{{name}}} for it")
        if OUTPUT not in asked:
            raise ValueError("the command has no {output}, the file that it has to write")
        return self

    def _remesher(self, parameters: dict[str, Parameter], folder: Path) -> Remesher:
        words = [self._filled(word, parameters, folder) for word in self.command]
        suffixes, most = (self.input, self.output), self.largest_output
        make = partial(run_command, words=words, suffixes=suffixes, timeout=self.timeout, largest_output=most)
        found = {word: re.search(r"\{folder\}/.+", word) for word in self.command}
        files = {word: Path(self._filled(match[0], {}, folder)) for word, match in found.items() if match}
        return make, {"command": list(self.command), "input": self.input, "output": self.output}, files

    @staticmethod
    def _filled(word: str, parameters: Mapping[str, Parameter], folder: Path) -> str:
        """Return a word of a command with its parameters and the folder of the study."""
        values = {_FOLDER: str(folder.absolute()), **{key: _as_text(value) for key, value in parameters.items()}}
        return PLACEHOLDER.sub(lambda found: values.get(found[1], found[0]), word)

    def _found_version(self, folder: Path) -> str | None:
        """Return what the version's command prints; see `MeshCache.version`."""
        words = [self._filled(word, {}, folder) for word in self.version or ()]
        return self._cache.version(self.version, words) if self.version else None


class FunctionSource(RemesherSource):
    """Meshes that a function of Python makes of one other mesh.

    The table of a family in Python names it as its source: ``{"source": remesh, "mesh": ..., "triangles": [500]}`` has
    ``remesh(mesh, triangles=500)`` called, which returns a mesh or anything that `as_mesh` takes. Dask takes the
    function to the workers.

    Attributes:
        function: The function; in a store its name alone, with which no mesh can be made.
        version: Text that changes whenever the function makes other meshes; by default a digest of its source.
    """

    function: Callable[..., Any] | str
    version: str | None = Field(default=None, validate_default=True)

    @field_validator("version")
    @classmethod
    def _at_hand(cls, version: str | None, info: ValidationInfo) -> str | None:
        # Workers get a function of a script or a notebook without its source.
        if version is not None or not callable(function := info.data.get("function")):
            return version
        with refused_by_pydantic():
            return function_version(function)

    def _remesher(self, parameters: dict[str, Parameter], folder: Path) -> Remesher:
        make = partial(call_function, function=self.function, parameters=parameters)
        return make, {"function": function_name(self.function)}, {}

    def _found_version(self, folder: Path) -> str | None:
        return self.version or function_version(self.function)


@dataclass(frozen=True)
class RemeshedMember(Member):
    """A mesh that a remesher makes, unless it is kept.

    The identity has the remesher, its parameters and its version; files are those that it reads besides.
    """

    make: Callable[[Mesh], Made]
    identity: Fingerprint
    original: Member
    files: Mapping[str, Path]
    cache: MeshCache

    names_wishes = True  # a remesher makes about as many triangles as it was asked for

    def load(self) -> Mesh:
        """Return the mesh that is kept, or make it and keep it; MeshError where that failed, or is not permitted."""
        digest = self.fingerprint_digest()
        if (mesh := self.cache.read(digest)) is not None:
            return mesh
        if not self.cache.may_run:
            not_kept = f"the remesher may not run, and its mesh is not kept in {self.cache.folder}"
            raise MeshError(f"{not_kept}; if you trust it, run with --allow-commands (in Python: allow_commands=True)")
        made = self.make(load_mesh(self.original))
        if self.fingerprint_digest() != digest:
            raise MeshError("a file of it was changed while it was made; run the study again")
        self.cache.write(digest, made, {"made by": self.identity, "of": self.original.name})
        if isinstance(made[1], str):
            raise MeshError(made[1])
        return made[1]

    def cost(self) -> Cost | None:
        """Return what making it took the last time."""
        with suppress(MeshError):
            return self.cache.cost(self.fingerprint_digest())
        return None

    def fingerprint(self) -> Fingerprint:
        """Return the identity, the digests of files and the fingerprint of the original."""
        files = {name: file_digest(path) for name, path in self.files.items()}
        return {**self.identity, "files": files, "of": dict(self.original.fingerprint())}

    def expected_size(self) -> ExpectedSize:
        """Return the size of the original, since nothing is known of the result."""
        return replace(self.original.expected_size(), is_known=False)


def call_function(mesh: Mesh, function: Callable[..., Any] | str, parameters: Mapping[str, Parameter]) -> Made:
    """Call a function that makes a mesh of another one; see `FunctionSource`."""
    if isinstance(function, str):
        return Cost(), f"the function {function} is not at hand; run the study from Python with it"
    started, processor = time.perf_counter(), time.thread_time()
    made: Mesh | str
    try:
        made = as_mesh(function(mesh, **parameters))
    except KeyboardInterrupt:
        raise
    # Libraries end the process where they fail to read, which would be that of the worker; those in Rust panic.
    except BaseException as error:
        made = f"{function_name(function)}: {type(error).__name__}: {one_line(error)}"
    return Cost(time.perf_counter() - started, time.thread_time() - processor), made


def function_name(function: Callable[..., Any] | str) -> str:
    """Return the name of a function, with that of its module."""
    if isinstance(function, str):
        return function
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__name__)}"


def function_version(function: Callable[..., Any] | str) -> str:
    """Return a digest of a function's source; StudyError where it has none."""
    try:
        return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()  # type: ignore[arg-type]
    except (OSError, TypeError) as error:
        hint = 'give "version", a text that changes whenever it makes other meshes'
        raise StudyError(f"the source of {function_name(function)} is not at hand; {hint}") from error


def _as_text(value: Parameter) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return number_as_text(value) if isinstance(value, float) else str(value)
