"""VTK's files: what the library reads of them is a whole mesh, or none."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from sobolev_batch import read_mesh
from sobolev_batch.errors import MeshError
from tests.support.mesh_files import write_with
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
    "a line of three corners": (
        lambda: pyvista.UnstructuredGrid(cells(BOX_TRIANGLES), [5] * 11 + [3], BOX_VERTICES),
        "cell 12 is of VTK's type 3 with 3 corners",
    ),
    "curved triangles": (lambda: grid([[0, 1, 2, 3, 4, 5]], 22), "type 22 with 6 corners.*extract_surface"),
    "ghosts": (with_ghosts, "ghost cells"),
    "an image": (lambda: pyvista.ImageData(dimensions=(3, 3, 3)), "STRUCTURED_POINTS.*extract_surface"),
}


@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
@pytest.mark.parametrize("name", BAD)
def test_what_makes_no_mesh_is_refused(tmp_path: Path, name: str) -> None:
    make, reason = BAD[name]
    with pytest.raises(MeshError, match=f"scan.vtk: .*{reason}"):
        read_mesh(saved(make(), tmp_path / "scan.vtk"))


@pytest.mark.parametrize("suffix", [".vtk", ".vtp"])
@pytest.mark.parametrize("binary", [True, False])
def test_ghosts_are_refused_where_there_are_any(tmp_path: Path, suffix: str, binary: bool) -> None:
    for some in (0, 1):
        mesh = with_ghosts()
        mesh.cell_data["vtkGhostType"] *= np.uint8(some)
        # Points of other parts alone change nothing; the file also has a text, which is not read.
        mesh.point_data["vtkGhostType"], mesh.field_data["who"] = (
            np.array([0] * 7 + [1], dtype=np.uint8),
            ["a b", "c POINTS d"],
        )
        path = saved(mesh, tmp_path / f"scan{suffix}", binary=binary)
        path.write_bytes(path.read_bytes().replace(b"POINTS 8 ", b"points  8  "))
        if some:
            with pytest.raises(MeshError, match="ghost cells"):
                read_mesh(path)
        else:
            assert read_mesh(path).area == BOX_AREA


def test_ghosts_of_old_versions_are_refused(tmp_path: Path) -> None:
    path = saved(with_ghosts(), tmp_path / "scan.vtp", binary=False)
    path.write_bytes(path.read_bytes().replace(b"vtkGhostType", b"vtkGhostLevels"))
    assert pyvista.read(path)["vtkGhostType"].any()
    with pytest.raises(MeshError, match="ghost cells"):
        read_mesh(path)


def test_an_unknown_section_is_named(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtk", binary=False)
    path.write_bytes(path.read_bytes().replace(b"POLYGONS", b"POLYG\xff\xfeNS"))
    with pytest.raises(MeshError, match=r"scan\.vtk: it has the line 'POLYG.*NS 13 36'"):
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


FORMS = [(kind, *more) for kind in (".vtp", ".vtu") for more in ((0, 0), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1))]


@pytest.mark.parametrize(("suffix", "mode", "is_packed"), [*FORMS, (".vtk", 42, 0), (".vtk", 42, 1), (".vtk", 51, 1)])
@pytest.mark.parametrize("order", [0, 1])
def test_all_forms_that_the_library_writes_are_read(
    tmp_path: Path, suffix: str, mode: int, is_packed: int, order: int
) -> None:
    mesh, path = polygons(BOX_MIXED, AWKWARD_VERTICES, verts=[1, 0], lines=[2, 0, 7]), tmp_path / f"scan{suffix}"
    mesh["height"], mesh.cell_data["of cells"] = mesh.points[:, 2], np.arange(mesh.n_cells)
    if suffix == ".vtk":
        writer: Any = vtkPolyDataWriter()
        writer.SetFileVersion(mode)
        writer.SetFileType(1 + is_packed)
    else:
        writer = vtkXMLPolyDataWriter() if suffix == ".vtp" else vtkXMLUnstructuredGridWriter()
        writer.SetDataMode(mode)
        writer.SetEncodeAppendedData(order)
        writer.SetByteOrder(order)
        writer.SetHeaderType(64 if order else 32)
        writer.SetBlockSize(64)
        getattr(writer, f"SetCompressorTypeTo{('None', 'ZLib', 'LZMA')[is_packed]}")()
    writer.SetFileName(str(path))
    writer.SetInputData(mesh if suffix != ".vtu" else mesh.cast_to_unstructured_grid())
    assert write_with(writer)
    read = read_mesh(path)
    if not mode or (suffix == ".vtk" and not is_packed):
        np.testing.assert_allclose(read.vertices, mesh.points, rtol=1e-9)
    else:
        assert read.vertices.tolist() == mesh.points.tolist()
    assert read.triangles.tolist() == read_mesh(saved(mesh, tmp_path / "other.vtk")).triangles.tolist()


def test_a_rare_packer_is_named_with_what_converts(tmp_path: Path) -> None:
    writer: Any = vtkXMLPolyDataWriter()
    writer.SetCompressorTypeToLZ4()
    writer.SetFileName(str(tmp_path / "scan.vtp"))
    writer.SetInputData(polygons(BOX_MIXED))
    assert write_with(writer)
    with pytest.raises(MeshError, match=r"vtkLZ4DataCompressor.*save it anew, as .vtp or .vtu") as refusal:
        read_mesh(tmp_path / "scan.vtp")
    # The command itself, without a process of its own.
    code = str(refusal.value).partition('python -c "')[2].removesuffix('"')
    exec(code.replace("'scan", f"'{tmp_path}/scan").replace("'new", f"'{tmp_path}/new"))
    assert read_mesh(tmp_path / "new.vtp").area == BOX_AREA


def test_a_box_of_several_pieces_is_one(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtp", binary=False)
    start, piece, end = re.split(rb"(?s)(<Piece.*</Piece>)", path.read_bytes())
    path.write_bytes(start + piece + piece + end)
    read = read_mesh(path)
    assert (read.area, len(read.vertices), read.counts["duplicate_triangles"]) == (2 * BOX_AREA, 16, 0)
    path.write_bytes(start + piece + piece.replace(b"0 6 4", b"0 6 9") + end)
    with pytest.raises(MeshError, match=r"index outside 0\.\.7"):
        read_mesh(path)


def test_arrays_without_a_format_are_text(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtp", binary=False)
    path.write_bytes(path.read_bytes().replace(b' format="ascii"', b""))
    assert read_mesh(path).area == pyvista.read(path).area == BOX_AREA


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"UInt32", b"UInt31", "counts in 'uint31'"),
        (b"LittleEndian", b"Littleendian", "byte order 'Littleendian'"),
        (b'NumberOfPolys="12"', b'NumberOfPolys="11"', "announces 11 polys, and has 12"),
        (b'Name="offsets"', b'Name="offset"', "announces|do not run"),
        (b'"Float64"', b'"Float63"', "the type 'Float63'"),
    ],
)
def test_xml_that_contradicts_itself_is_refused(tmp_path: Path, old: bytes, new: bytes, reason: str) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtp")
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(MeshError, match=reason):
        read_mesh(path)


def test_a_count_of_billions_takes_no_memory(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtk", binary=False)
    text = path.read_bytes()
    for old, new in ((b"POINTS 8", b"POINTS 3000000000"), (b"POLYGONS 13 36", b"POLYGONS 3000000000 36")):
        assert old in text
        path.write_bytes(text.replace(old, new))
        with pytest.raises(MeshError, match="breaks off"):
            read_mesh(path)


def test_a_byte_lost_from_the_points_is_noticed(tmp_path: Path) -> None:
    path = saved(polygons(BOX_TRIANGLES), tmp_path / "scan.vtk")
    text = path.read_bytes()
    start = text.index(b"double\n") + 40
    path.write_bytes(text[:start] + text[start + 1 :])
    with pytest.raises(MeshError, match="do not end where a line does"):
        read_mesh(path)


def test_damaged_blocks_of_lzma_are_refused(tmp_path: Path) -> None:
    path, writer = tmp_path / "scan.vtp", vtkXMLPolyDataWriter()
    writer.SetCompressorTypeToLZMA()
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetFileName(str(path))
    writer.SetInputData(polygons(BOX_MIXED))
    assert write_with(writer)
    data = path.read_bytes()
    place = data.index(b"\xfd7zXZ")
    path.write_bytes(data[: place + 20] + bytes(20) + data[place + 40 :])
    with pytest.raises(MeshError, match="its packed data are damaged"):
        read_mesh(path)
