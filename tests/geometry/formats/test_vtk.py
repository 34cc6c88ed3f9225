"""VTK's files: what the library reads of them is a whole mesh, or none."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from tests.support.shapes import AWKWARD_VERTICES, BOX_AREA, BOX_MIXED, BOX_QUADS, BOX_TRIANGLES, BOX_VERTICES, CLOSED

KINDS = [(suffix, binary) for suffix in (".vtk", ".vtp", ".vtu") for binary in (True, False)]


def cells(faces: list[list[int]]) -> list[int]:
    """Faces as VTK counts them: each with its number of corners before it."""
    return [number for face in faces for number in (len(face), *face)]


def polygons(faces: list[list[int]], vertices: Any = BOX_VERTICES, **more: Any) -> Any:
    return pyvista.PolyData(np.array(vertices, dtype=np.float64), cells(faces), **more)


def grid(faces: list[list[int]], kind: int) -> Any:
    return pyvista.UnstructuredGrid(cells(faces), [kind] * len(faces), BOX_VERTICES)


def saved(mesh: Any, path: Path, *, binary: bool = True) -> Path:
    if path.suffix == ".vtu":
        mesh = mesh.cast_to_unstructured_grid()
    mesh.save(path, binary=binary)
    return path


@pytest.mark.parametrize(("suffix", "binary"), KINDS)
def test_vertices_and_triangles_are_those_of_the_file(tmp_path: Path, suffix: str, binary: bool) -> None:
    mesh = polygons(BOX_TRIANGLES, AWKWARD_VERTICES if binary else BOX_VERTICES)
    mesh["height"], mesh.field_data["time"] = mesh.points[:, 2], [1.5]
    path = saved(mesh, tmp_path / f"scan{suffix}", binary=binary)
    assert read_mesh(path).triangles.tolist() == BOX_TRIANGLES
    # As text, VTK writes eleven digits.
    assert read_mesh(path).vertices.tolist() == mesh.points.tolist()


@pytest.mark.parametrize(("suffix", "binary"), KINDS)
@pytest.mark.parametrize("faces", [BOX_QUADS, BOX_MIXED[::-1]], ids=["quads", "mixed"])
def test_polygons_are_cut_into_fans(tmp_path: Path, faces: list[list[int]], suffix: str, binary: bool) -> None:
    # Vertices and lines have no area.
    mesh = polygons(faces, verts=[1, 0], lines=[2, 0, 7])
    read = read_mesh(saved(mesh, tmp_path / f"scan{suffix}", binary=binary))
    assert (read.area, read.counts, read.triangles.shape) == (BOX_AREA, CLOSED, (12, 3))


@pytest.mark.parametrize(("suffix", "binary"), KINDS)
@pytest.mark.parametrize("kept", [0.1, 0.6, 0.95])
def test_a_file_that_breaks_off_is_refused_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str, binary: bool, kept: float
) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / f"scan{suffix}", binary=binary)
    content = path.read_bytes()
    # What follows the triangles in a legacy file does not matter.
    end = content.find(b"METADATA", content.find(b"CONNECTIVITY")) if suffix == ".vtk" else len(content)
    path.write_bytes(content[: int(kept * end)])
    with pytest.raises(MeshError, match=rf"scan\{suffix}: "):
        read_mesh(path)
    assert "".join(capfd.readouterr()) == ""


def with_ghosts() -> Any:
    mesh = polygons(BOX_TRIANGLES)
    mesh.cell_data["vtkGhostType"] = np.array([0] * 11 + [1], dtype=np.uint8)
    return mesh


BAD: dict[str, tuple[Callable[[], Any], str]] = {
    "index -1": (lambda: polygons([*BOX_TRIANGLES, [0, 1, -1]]), r"#12 = \[0, 1, -1\]"),
    "index 8": (lambda: polygons([*BOX_TRIANGLES, [0, 1, 8]]), r"#12 = \[0, 1, 8\]"),
    "two corners": (lambda: polygons([*BOX_TRIANGLES, [0, 1]]), "face 13 has 2 vertices"),
    "NaN": (lambda: polygons(BOX_TRIANGLES, BOX_VERTICES / np.where(BOX_VERTICES == 4, 0, 1)), "infinite"),
    "lines alone": (lambda: pyvista.PolyData(BOX_VERTICES, lines=[2, 0, 7]), "no faces"),
    "tetrahedra": (lambda: grid([[0, 1, 2, 4]], 10), r"type 10 with 4 corners.*read\('scan.vtk'\).extract_surface"),
    "triangles of four corners": (lambda: grid(BOX_QUADS, 5), "type 5 with 4 corners"),
    "curved triangles": (lambda: grid([[0, 1, 2, 3, 4, 5]], 22), "type 22 with 6 corners.*extract_surface"),
    "ghosts": (with_ghosts, "ghost cells"),
    "an image": (lambda: pyvista.ImageData(dimensions=(3, 3, 3)), "vtkStructuredPoints.*extract_surface"),
}


@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
@pytest.mark.parametrize("name", BAD)
def test_what_makes_no_mesh_is_refused(tmp_path: Path, name: str) -> None:
    make, reason = BAD[name]
    with pytest.raises(MeshError, match=f"scan.vtk: .*{reason}"):
        read_mesh(saved(make(), tmp_path / "scan.vtk"))


def test_what_the_library_reports_need_not_be_text(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtk", binary=False)
    path.write_bytes(path.read_bytes().replace(b"POLYGONS", b"POLYG\xff\xfeNS"))
    with pytest.raises(MeshError, match=r"scan\.vtk: VTK reports: .*Unrecognized keyword: polyg"):
        read_mesh(path)


# Grids of cells by their types, and what notes tell of their other cells.
GRIDS: dict[str, tuple[list[tuple[int, list[list[int]]]], str]] = {
    "pixels": ([(8, [[q[0], q[1], q[3], q[2]] for q in BOX_QUADS])], ""),
    "strips": ([(6, [[q[0], q[1], q[3], q[2]] for q in BOX_QUADS[:3]]), (5, BOX_TRIANGLES[6:])], ""),
    "faces of tetrahedra": ([(10, [[0, 1, 2, 4], [1, 2, 3, 7]]), (9, BOX_QUADS)], "2 cells with volume .* 6 faces"),
}


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("suffix", [".vtk", ".vtu"])
def test_grids_give_their_faces(tmp_path: Path, name: str, suffix: str) -> None:
    parts, note = GRIDS[name]
    faces = [face for _, some in parts for face in some]
    kinds = [kind for kind, some in parts for _ in some]
    pyvista.UnstructuredGrid(cells(faces), kinds, BOX_VERTICES).save(tmp_path / f"scan{suffix}")
    mesh = read_mesh(tmp_path / f"scan{suffix}")
    # Neither strips nor pixels tell the side.
    counts = {key: value for key, value in CLOSED.items() if key != "inconsistent_edges"}
    assert mesh.area == BOX_AREA
    assert counts.items() <= mesh.counts.items()
    assert re.fullmatch(f"({note}.*)?", "".join(mesh.notes))


@pytest.mark.parametrize("suffix", [".vtk", ".vtp"])
def test_strips_lie_beside_polygons(tmp_path: Path, suffix: str) -> None:
    strips = [number for q in BOX_QUADS[:2] for number in (4, q[0], q[1], q[3], q[2])]
    read = read_mesh(saved(polygons(BOX_QUADS[2:], strips=strips), tmp_path / f"scan{suffix}"))
    assert (read.area, read.counts) == (BOX_AREA, CLOSED)


def test_a_comment_without_end_is_refused_before_the_library_reads_it(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtp")
    path.write_bytes(path.read_bytes().replace(b"<Piece", b"<!--" + b"x" * (2 << 20) + b"--><Piece", 1))
    with pytest.raises(MeshError, match="comment of more than"):
        read_mesh(path)


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtp")
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(MeshError, match=r"scan\.vtp: .*sobolev-batch\[vtk\]"):
        read_mesh(path)
