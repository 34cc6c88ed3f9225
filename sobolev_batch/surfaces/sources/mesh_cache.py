"""Meshes that took long to make, kept in a folder or in object storage under the digest of what they depend on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.plain_formats import parse_ply, write_ply
from sobolev_batch.surfaces.shapes.mesh import Mesh

_NOTHING_KNOWN = float("nan")


class Folder(Protocol):
    """A place for files, local or remote."""

    def read(self, key: str) -> bytes | None:
        """Return the bytes of a file, or None if it does not exist."""

    def write(self, documents: Mapping[str, bytes]) -> None:
        """Write files by their keys, each as a whole."""


@dataclass(frozen=True)
class Cost:
    """Time, memory and exit status of making a mesh; NaN where they are not known.

    Attributes:
        make_seconds: Time from the start to the end.
        make_cpu_seconds: Processor time.
        make_peak_bytes: Largest memory of the process.
        exit_status: Exit status of the program; negative if a signal ended it.
    """

    make_seconds: float = _NOTHING_KNOWN
    make_cpu_seconds: float = _NOTHING_KNOWN
    make_peak_bytes: float = _NOTHING_KNOWN
    exit_status: float = _NOTHING_KNOWN


@dataclass(frozen=True)
class Outcome:
    """A mesh that was made, or why it was not.

    Attributes:
        cost: What it took.
        mesh: The mesh; None after a failure.
        reason: Reason of the failure; empty otherwise.
    """

    cost: Cost
    mesh: Mesh | None = None
    reason: str = ""


@dataclass(frozen=True)
class MeshCache:
    """A folder of meshes that programs or functions made, and whether these may run.

    A mesh is the file DIGEST.ply; DIGEST.json beside it says what made it and what that took.

    Attributes:
        folder: Place of the files.
        may_run: True if what is not there may be made.
    """

    folder: Folder
    may_run: bool = False

    def read(self, digest: str) -> Mesh | None:
        """Return the mesh that is kept under a digest; None where there is none, or a damaged one."""
        kept = self._entry(digest).get("mesh")
        data = self.folder.read(f"{digest}.ply") if kept else None
        if data is None:
            return None
        try:
            mesh = Mesh(*parse_ply(data))
        except (MeshError, ValueError):
            return None
        return mesh if mesh.digest == kept else None

    def cost(self, digest: str) -> Cost | None:
        """Return what the last attempt to make a mesh took; None where there was none."""
        try:
            return Cost(**{name: float(value) for name, value in dict(self._entry(digest)["cost"]).items()})
        except (KeyError, TypeError, ValueError):
            return None

    def write(self, digest: str, outcome: Outcome, about: Mapping[str, Any]) -> None:
        """Keep what was made, or what a failure took, with a description of what made it."""
        mesh = outcome.mesh
        if mesh is not None:
            self.folder.write({f"{digest}.ply": write_ply(mesh)})
        # It makes the mesh count, so it comes last.
        entry = {"mesh": mesh and mesh.digest, "cost": asdict(outcome.cost), "reason": outcome.reason, **about}
        self.folder.write({f"{digest}.json": json.dumps(entry, indent=1, default=str).encode()})

    def _entry(self, digest: str) -> dict[str, Any]:
        try:
            entry = json.loads(self.folder.read(f"{digest}.json") or b"{}")
        except ValueError:
            return {}
        return entry if isinstance(entry, dict) else {}
