"""Files made to hang or to exhaust a reader: refused in seconds, and in memory that follows their size."""

from __future__ import annotations

import gzip
import os
import re
import sys
import time
from pathlib import Path

import pytest

from sobolev_batch import read_mesh, write_mesh
from sobolev_batch.errors import MeshError
from sobolev_batch.geometry.formats import parsing
from sobolev_batch.geometry.formats.readers import expected_size
from sobolev_batch.shapes import icosphere
from tests.support.mesh_attacks import ATTACKS
from tests.support.mesh_files import LITTLE, ply
from tests.support.shapes import BOX_TRIANGLES, BOX_VERTICES

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is measured by Linux's /proc")

# Of this process alone, whatever else the machine does. Most take a tenth of a second.
_LONGEST_SECONDS = 20
# What refusing may take besides a multiple of the file: what packed data may grow to in any case, and its parsing.
_SPARE_BYTES, _BYTES_PER_BYTE = 150 << 20, 150
# It begins like a mesh of which all but the header is zeros.
BINARY_PLY = ply(BOX_VERTICES, BOX_TRIANGLES, LITTLE, vertex_count=5 * 10**8)
# Why some are refused, where they could be refused for less.
REASONS = {
    "FIFO .ply": "it is a pipe",
    "ply, sparse": r"scan\.ply: larger than 8589934592 bytes.*1099511627776",
    "stl, sparse": r"scan\.stl: larger than 8589934592 bytes.*1099511627776",
    "gltf, buffer ../data.bin": "needs '../data.bin', which is no file in its folder; put it there",
    "bomb .ply.gz": "no mesh file shrinks that far",
    "gifti, bomb": "unpacks to more than the 96 bytes announced",
    "gifti, bomb that is announced": "no mesh file shrinks that far",
    "gifti, a billion laughs": "declares the entity",
    "gifti, data of another file": "its data lie in another file",
    "gifti, long attribute": r"goes on at byte \d{5};",
    "gifti, deep elements unpacked": "at the depth 101",
    "gifti, many elements unpacked": "element 100001",
    "obj, continued lines unpacked": "goes on for more than",
    "ply ascii, long line unpacked": "but 1 numbers more follow",
    "glb, one part in many nodes": "repeats parts",
    "glb, stride 0": "every 0 bytes",
    "ply, indices with fractions": "not integers",
    "ply ascii, wide rows of list uchar double": "announces .* but only",
    "obj, huge coordinate": "rescale it",
    "ply ascii, float overflow": "NaN or infinite",
}
# What bounds any size: no format has less of a file for each triangle, nor takes more memory for it.
_LEAST_BYTES, _MOST_MEMORY = 3, 1300


def _peak_bytes() -> int:
    """The most memory that was resident since the peak was last reset."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def disk_bytes(folder: Path) -> int:
    """What all files of a folder take up."""
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if not path.is_symlink())


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.all if name.endswith(" unpacked") else ()) for name in ATTACKS]
)
def test_attacks_are_refused_in_bounded_time_and_memory(tmp_path: Path, name: str) -> None:
    path = ATTACKS[name](tmp_path)
    held_bytes = disk_bytes(tmp_path)
    Path("/proc/self/clear_refs").write_text("5")
    before, start = _peak_bytes(), time.process_time()
    with pytest.raises(MeshError, match=REASONS.get(name)) as caught:
        read_mesh(path)
    assert time.process_time() - start < _LONGEST_SECONDS
    assert _peak_bytes() - before < _SPARE_BYTES + _BYTES_PER_BYTE * held_bytes
    assert len(str(caught.value)) < 900
    # One that an "except Exception" swallowed.
    assert "Warning" not in str(caught.value)
    # No size is claimed that the file cannot hold: packed files count as what they may unpack to.
    triangles, memory_bytes = expected_size(path)
    most = held_bytes * (4 if path.suffix == ".gz" else 1) / _LEAST_BYTES
    if not name.endswith(", sparse"):
        assert 0 <= triangles <= most
        assert 0 <= memory_bytes <= most * _MOST_MEMORY


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".off", ".glb", ".gii", "_lh.pial"])
def test_files_beyond_the_memory_are_refused_unread(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parsing, "machine_memory", lambda: (4 * 10**9, "all of this machine"))
    path = tmp_path / f"scan{ending}"
    # What it announces fits its length, and nothing of it is on the disk.
    path.write_bytes(BINARY_PLY if ending == ".ply" else b"")
    os.truncate(path, 7 * 10**9)
    before = time.process_time()
    expected = rf"scan{re.escape(ending)}: takes up to .*GB of memory to read, and may take 75% of 4\.0GB, all of this"
    with pytest.raises(MeshError, match=expected):
        read_mesh(path)
    assert time.process_time() - before < 1


def test_a_small_file_is_read_without_a_look_at_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Control groups are a dozen files: among thousands of tiny meshes, most of the time would go there.
    monkeypatch.setattr(parsing, "machine_memory", lambda: pytest.fail("looked at the limits"))
    write_mesh(icosphere(0), tmp_path / "scan.ply")
    assert len(read_mesh(tmp_path / "scan.ply").triangles) == 20


def test_packed_files_are_refused_as_soon_as_they_exceed_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scan.obj.gz").write_bytes(gzip.compress(b"# comment\n" * 3_000_000 + os.urandom(1 << 19)))
    monkeypatch.setattr(parsing, "machine_memory", lambda: (200_000_000, "all of this machine"))
    with pytest.raises(MeshError, match=r"scan\.obj\.gz: takes up to 15\d\.\dMB of memory to read, and may take 75% "):
        read_mesh(tmp_path / "scan.obj.gz")
