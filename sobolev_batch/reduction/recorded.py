"""The search for the fewest triangles of one mesh, recorded after each trial, so that it goes on where it was ended."""

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import PurePath

from pydantic import TypeAdapter, ValidationError

from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats.by_name import WRITERS
from sobolev_batch.geometry.formats.ply import parse_ply
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.reduction.limit import Limit
from sobolev_batch.reduction.remesher import Remesher
from sobolev_batch.reduction.search import PRECISION, Bracket, Search, Trial
from sobolev_batch.sources.mesh_cache import Folder
from sobolev_batch.sources.registry import Member, digest_of, load_mesh

# Raise it whenever a mesh of one size is judged in another way: trials of another version are made again.
_VERSION = 7
# Measured peak of a trial: for each triangle of the original, and of the libraries.
_TRIAL_BYTES, _LEAST_BYTES = 1400, 3e8
# Over sizes more than this factor apart, the triangles of a remesher that uses them follow at least this power of them.
_APART, _LEAST_POWER = 1.5, 0.1


@dataclass(frozen=True)
class SearchRecord:
    """Record of a search: a JSON file that is replaced as a whole after each trial.

    Triangles and the radius of the bounding sphere are those of the original. The digests are those of the search,
    since another one has other trials, of the file of the best mesh, and of the file that this one replaces.
    """

    digest: str
    triangles: int
    radius: float
    mesh_digest: str = ""
    replaced_digest: str = ""
    trials: tuple[Trial, ...] = ()


_RECORDS = TypeAdapter(SearchRecord)


@dataclass(frozen=True, eq=False)
class RecordedSearch:
    """A mesh to reduce, how, and where what is known of it is kept.

    Attributes:
        original: Mesh that is remeshed.
        reference: Mesh from which those found may be as far away as the limit says.
        folder: Place of the record and of the best mesh.
        name: Name of the record without its suffix; by default the digest of the search.
        mesh_key: Name of the file of the mesh; by default that of the record with the suffix .ply.
    """

    original: Member
    reference: Member
    limit: Limit
    remesher: Remesher
    folder: Folder
    name: str = ""
    mesh_key: str = ""
    precision: float = PRECISION

    @property
    def digest(self) -> str:
        """SHA-256 of all that trials depend on; MeshError where a file of it cannot be read."""
        about = [self.remesher.fingerprint(self.original), self.reference.fingerprint(), repr(self.limit)]
        return digest_of([_VERSION, *about])

    def projected_bytes(self, triangles: int) -> float:
        """Return the memory that a trial takes with an original of some triangles; without any, that to read it."""
        return _LEAST_BYTES + self.original.expected_size().projected_bytes + _TRIAL_BYTES * triangles

    def recorded(self) -> SearchRecord | None:
        """Return the record; None where there is none of the same search, or where nothing could be made so far."""
        digest = self.digest
        record = self._stored(digest)
        # A program that was missing may be there now, so a search that made nothing begins anew.
        if record is None or record.digest != digest or not any(one.triangles for one in self._counted(record)):
            return None
        return record

    def begun(self) -> SearchRecord:
        """Return the record of a search that begins; MeshError where the original cannot be read."""
        mesh = load_mesh(self.original)
        return SearchRecord(self.digest, len(mesh.triangles), mesh.bounding_sphere[1])

    def bracket(self, record: SearchRecord) -> Bracket:
        """Return what the trials say."""
        return self._search(record).bracket(self._counted(record))

    def next(self, record: SearchRecord, count: int = 1) -> tuple[float, ...]:
        """Return sizes to try now, up to a count of them; that of the best mesh where its file is gone or another."""
        sizes, best = self._search(record).next(record.trials, count), self.bracket(record).best
        if not sizes and best is not None and _digest(self._read_mesh(record)) != record.mesh_digest:
            return (best.size,)
        return sizes

    def trial(self, record: SearchRecord, size: float) -> tuple[Member, Member, Limit, float]:
        """Return the arguments of `tried` for a size."""
        return self.reference, self.remesher.member(self.original, size, record.triangles), self.limit, size

    def taken(self, record: SearchRecord, outcome: tuple[Trial, Mesh | None]) -> SearchRecord:
        """Record the outcome of a trial, then write its mesh if that is the best one; return the record."""
        if self.digest != record.digest:
            raise MeshError("a file of it was changed while it was searched; try again")
        trial, mesh = outcome
        record = replace(record, trials=(*(one for one in record.trials if one.size != trial.size), trial))
        written: dict[str, bytes] = {}
        if mesh is not None and self.bracket(record).best == trial:
            key = self._key_of_mesh(record)
            replaced, written[key] = self._read_mesh(record), WRITERS[PurePath(key).suffix](mesh)
            record = replace(record, mesh_digest=_digest(written[key]), replaced_digest=_digest(replaced))
        # The record is written first: each mesh then has a record, and a mesh that is missing is made again.
        self.folder.write({f"{self.name or record.digest}.json": _RECORDS.dump_json(record, exclude_defaults=True)})
        self.folder.write(written)
        return record

    def make_room(self) -> None:
        """Remove the mesh of an earlier search; MeshError where another file lies in its place."""
        self.forget()
        self._read_mesh(SearchRecord("", 0, 0.0))

    def forget(self) -> None:
        """Remove the mesh that an earlier search has left under this name, unless another file has replaced it."""
        record = self._stored()
        # What was searched before may have had another format.
        for key in (f"{self.name}{suffix}" for suffix in WRITERS):
            if record is not None and _is_of(record, self.folder.read(key)):
                self.folder.discard(key)

    def reason(self, record: SearchRecord) -> str:
        """Return why nothing was found; empty where something was."""
        if self.bracket(record).best is not None:
            return ""
        counted, too_far = self._counted(record), f"nothing is within the tolerance of {self.limit.largest:.4g}"
        text = self._nearest(record, counted, f"{too_far}; nearest are ")
        return "; ".join(filter(None, (text, self._unfollowed(record))))

    def remarks(self, record: SearchRecord) -> tuple[str, ...]:
        """Return what one should know of what was found, a sentence each; nothing where nothing was."""
        bracket = self.bracket(record)
        if (best := bracket.best) is None:
            return ()
        failed = bracket.failed
        is_original = self.remesher.keeps(best.size, record.triangles)
        of = "original" if self.original is self.reference else "reference"
        itself = ": the smallest of those tried that does is the original itself" if is_original else ""
        if others := [one for one in record.trials if is_original and one.triangles and not one.is_within]:
            itself += f"; of the others, {self._nearest(record, others, 'nearest are ')}"
        # A search takes sizes that fail beside each other for too coarse ones.
        is_open = failed and failed.reason and not any(0 < one.triangles < best.triangles for one in record.trials)
        texts = (
            f"size {failed.size:g} failed: {failed.reason}" if failed and failed.reason else "",
            "no mesh with fewer triangles was made, and one may hold" if is_open else "",
            "" if bracket.is_monotone else "not monotone: a finer mesh was worse",
            f"no smaller mesh held{itself}; another method may make one" if best.triangles >= record.triangles else "",
            best.broken and f"it is broken, unlike the {of}: {best.broken}",
            self._unfollowed(record),
        )
        return tuple(filter(None, texts))

    def _nearest(self, record: SearchRecord, trials: Sequence[Trial], text: str) -> str:
        """Return a text with the nearest of some trials, or else why that one could not be measured."""
        # Where a mesh was clearly too far away, its upper bound was left where it was.
        nearest = min(trials, key=lambda one: (one.lower, one.upper))
        itself = " of the original itself" if self.remesher.keeps(nearest.size, record.triangles) else ""
        measure = f"{'1 - ' * self.limit.is_score}{self.limit.measure}"
        found = f"{nearest.triangles:,} triangles{itself}, at least {nearest.lower:.4g} away ({measure})"
        return nearest.reason or f"{text}{found}"

    def _unfollowed(self, record: SearchRecord) -> str:
        """Return a sentence where the remesher makes about as many triangles whatever the size; else nothing."""
        made = [one for one in record.trials if one.triangles and not self.remesher.keeps(one.size, record.triangles)]
        pairs = zip(*((one.size, one.triangles) for one in made), strict=True)
        (low, high), (fewest, most) = [(min(values), max(values)) for values in pairs] or [(1, 1)] * 2
        if high <= _APART * low or most > fewest * (high / low) ** _LEAST_POWER:
            return ""
        name, counts = self.remesher.parameter, " to ".join(f"{one:,}" for one in dict.fromkeys((fewest, most)))
        return (
            f"sizes do not follow {name}: asked for {low:g} to {high:g}, the method made {counts} triangles; "
            f"see whether it uses {name}"
        )

    def mesh(self, record: SearchRecord) -> Mesh:
        """Return the best mesh, which is kept as a PLY file."""
        return Mesh(*parse_ply(self._read_mesh(record)))

    def _stored(self, digest: str = "") -> SearchRecord | None:
        """Return the last record under the name, of whatever search, or else under a digest."""
        with suppress(ValidationError):
            return _RECORDS.validate_json(self.folder.read(f"{self.name or digest}.json") or b"", strict=True)
        return None

    def _counted(self, record: SearchRecord) -> tuple[Trial, ...]:
        """Return the trials, without the original itself where the remesher made nothing at any other size."""
        made = tuple(one for one in record.trials if not self.remesher.keeps(one.size, record.triangles))
        return made if made and not any(one.triangles for one in made) else record.trials

    def _search(self, record: SearchRecord) -> Search:
        return self.remesher.search(self.limit, record.triangles, record.radius, self.precision)

    def _key_of_mesh(self, record: SearchRecord) -> str:
        return self.mesh_key or f"{record.digest}.ply"

    def _read_mesh(self, record: SearchRecord) -> bytes:
        """Return the file of the best mesh, or nothing; MeshError where a file of somebody else lies in an output."""
        data = self.folder.read(self._key_of_mesh(record))
        if self.mesh_key and data is not None and not _is_of(record, data):
            problem = f"no record says that a search wrote {self.mesh_key} in the output"
            raise MeshError(f"{problem}; move it, or name another folder")
        return data or b""


def _is_of(record: SearchRecord, data: bytes | None) -> bool:
    """Tell whether a file is the mesh of a search, or the one that the search was about to replace."""
    return data is not None and _digest(data) in (record.mesh_digest, record.replaced_digest)


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
