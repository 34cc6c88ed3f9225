"""A cache of meshes that took long to make, and of the versions of programs that made them."""

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.ply import parse_ply, write_ply
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.sources.programs import Cost, Made, printed


class Folder(Protocol):
    """A place for files, local or remote."""

    def read(self, key: str) -> bytes | None:
        """Return the bytes of a file, or None if it does not exist."""

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write files by their keys, each as a whole."""

    def discard(self, key: str) -> object:
        """Remove a file."""


class InMemory(dict[str, bytes]):
    """A place for files that ends with the process."""

    read, write, discard = dict.get, dict.update, dict.pop

    def __str__(self) -> str:
        return "memory"


@dataclass(frozen=True)
class MeshCache:
    """A folder of meshes that programs or functions made, and whether these, and searches with them, may run.

    A mesh is the file DIGEST.ply; DIGEST.json beside it says what made it and what that took. A file for each command
    that prints the version of a program has what it printed last.

    Attributes:
        assumed: Commands whose versions were taken as printed last, and these, by the keys of files, which may change.
        asked: Versions that commands have printed since this object was made, by the same keys.
    """

    folder: Folder
    may_run: bool = False
    may_search: bool = True
    assumed: dict[str, tuple[Sequence[str], str]] = field(default_factory=dict, init=False, compare=False, repr=False)
    asked: dict[str, str] = field(default_factory=dict, init=False, compare=False, repr=False)

    def read(self, digest: str) -> Mesh | None:
        """Return the mesh that is kept under a digest; None where there is none, or a damaged one."""
        kept = self._entry(digest).get("mesh")
        data = self.folder.read(f"{digest}.ply") if kept else None
        with suppress(MeshError, ValueError):
            if data is not None and (mesh := Mesh(*parse_ply(data))).digest == kept:
                return mesh
        return None

    def cost(self, digest: str) -> Cost | None:
        """Return what the last attempt to make a mesh took; None where there was none."""
        with suppress(KeyError, TypeError, ValueError):
            return Cost(**{name: float(value) for name, value in dict(self._entry(digest)["cost"]).items()})
        return None

    def write(self, digest: str, made: Made, about: Mapping[str, Any]) -> None:
        """Keep what was made, or what a failure took, with a description of what made it."""
        cost, mesh = made
        if isinstance(mesh, Mesh):
            self.folder.write({f"{digest}.ply": write_ply(mesh)})
        # It makes the mesh count, so it comes last.
        kept, reason = (mesh.digest, "") if isinstance(mesh, Mesh) else (None, mesh)
        entry = {"mesh": kept, "cost": asdict(cost), "reason": reason, **about}
        self.folder.write({f"{digest}.json": json.dumps(entry, indent=1, default=str).encode()})

    def version(self, command: Sequence[str], words: Sequence[str]) -> str | None:
        """Return what a command, filled with words, printed last as the version of a program.

        It runs where that is not known. None where it may not run then; StudyError where it fails.
        """
        key = f"version-{hashlib.sha256(shlex.join(command).encode()).hexdigest()}.txt"
        if key in self.asked:
            return self.asked[key]
        if key not in self.assumed:
            if not (known := (self.folder.read(key) or b"").decode(errors="replace")):
                return self._ask(key, words) if self.may_run else None
            self.assumed[key] = words, known
        return self.assumed[key][1]

    def versions_changed(self) -> bool:
        """Ask for the versions that were assumed, each once, and return whether any is another one."""
        for key, (words, _) in self.assumed.items():
            if self.may_run and key not in self.asked:
                self._ask(key, words)
        return any(self.asked.get(key, known) != known for key, (_, known) in self.assumed.items())

    def _ask(self, key: str, words: Sequence[str]) -> str:
        self.asked[key] = printed(words)
        self.folder.write({key: self.asked[key].encode()})
        return self.asked[key]

    def _entry(self, digest: str) -> dict[str, Any]:
        with suppress(ValueError):
            if isinstance(entry := json.loads(self.folder.read(f"{digest}.json") or b"{}"), dict):
                return entry
        return {}
