"""Formats of mesh files, found by the names of files: those of this package, and of others that are installed.

A format comes from an entry point of the group ``sobolev_batch.formats``, which names a tuple of `Format`. What is read
rarely comes the same way from the extras of this package.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePath

from sobolev_batch.geometry.formats import plain_formats
from sobolev_batch.geometry.formats.parsing import Raw, is_gzipped
from sobolev_batch.geometry.formats.ply import announced_size, parse_ply, write_ply
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.plugins import FORMATS, registered


@dataclass(frozen=True)
class Format:
    """A format of mesh files.

    Attributes:
        suffixes: Suffixes of its files, in lower case; one name without a dot where `is_name` tells its files.
        parse: Function of the contents of a file, which returns vertices and triangles. If there is `files_beside`, its
            second argument is the contents of those files by their names.
        file_bytes: Bytes of each triangle, in a file of nothing but positions and triangles.
        memory_bytes: Bytes of each triangle, at the measured peak of reading it.
        write: Function of a mesh, which returns the contents of a file; None for a format that is only read.
        is_name: Tells whether a name in lower case, without .gz, is that of a file of the format, where no suffix does.
        announced_size: Function of the beginning of a file and its length, which estimates its triangles and the peak
            of the memory that reading takes, where the beginning tells more than the length.
        files_beside: Function of the contents of a file, which returns the relative paths of files that it needs.
    """

    suffixes: tuple[str, ...]
    parse: Callable[..., Raw]
    file_bytes: int
    memory_bytes: int
    write: Callable[[Mesh], bytes] | None = None
    is_name: Callable[[str], bool] | None = None
    announced_size: Callable[[bytes, int], tuple[int, float]] | None = None
    files_beside: Callable[[bytes], tuple[str, ...]] | None = None


_PLAIN = (
    Format((".ply",), parse_ply, 19, 110, write_ply, announced_size=announced_size),
    Format((".obj",), plain_formats.parse_obj, 35, 240, plain_formats.write_obj),
    Format((".stl",), plain_formats.parse_stl, 50, 270, plain_formats.write_stl),
    Format((".off",), plain_formats.parse_off, 35, 240, plain_formats.write_off),
)


# The first format that has a suffix keeps it.
BY_SUFFIX: dict[str, Format] = {}
for _form in (*_PLAIN, *(form for point in registered(FORMATS) for form in point.load())):
    for _suffix in _form.suffixes:
        BY_SUFFIX.setdefault(_suffix, _form)
# What makes the contents of a file from a mesh, by suffix.
WRITERS = {suffix: form.write for suffix, form in BY_SUFFIX.items() if form.write is not None}


# Formats of files that are not read, by suffix, and commands that convert one which is called scan.
_PYTHON = 'pip install {}; python -c "{}"'
_MESHLAB = _PYTHON.format(
    "pymeshlab",
    "import pymeshlab; m = pymeshlab.MeshSet(); m.load_new_mesh('scan{0}'); "
    "m.generate_by_merging_visible_meshes(); m.save_current_mesh('scan.ply', save_textures=False)",
)
_PYVISTA = "import pyvista; pyvista.read('scan{0}').%sextract_surface().triangulate().save('scan.vtp')"
_GMSH = "pip install gmsh; gmsh scan{0} -2 -o scan.stl"
_RESAVED = "pip install gmsh; gmsh scan{0} -save -format msh41 -o surface.msh"
_ASSIMP = "assimp export scan{0} scan.ply"
_MESHIO = "pip install meshio h5py; meshio convert scan{0} scan.vtu"
# Meshio takes the nodes of all parts for those of one, and leaves out where an assembly places them.
_FLAT = f"{_MESHIO}  # where it has parts, first write it without, by noPartsInputFile=ON"
CONVERTED = {
    suffix: (name, command.format(suffix))
    for name, suffixes, command in (
        # Other programs leave out its skins, or cut polygons that are not convex as fans.
        ("COLLADA", ".dae", _ASSIMP),
        *(("VRML", ".wrl", _MESHLAB), ("X3D", ".x3d", _MESHLAB), ("3D Studio", ".3ds", _MESHLAB)),
        *(("OpenCTM", ".ctm", _MESHLAB), ("STEP", ".step .stp", _GMSH), ("IGES", ".iges .igs", _GMSH)),
        *(("BREP", ".brep", _GMSH), ("Abaqus", ".inp", _FLAT), ("Nastran", ".bdf .nas", _MESHIO)),
        *(("XDMF", ".xdmf", _MESHIO), ("Medit in binary", ".meshb", _MESHIO), ("I-deas", ".unv", _RESAVED)),
        *(("MED", ".med", _RESAVED), ("CGNS", ".cgns", _RESAVED), ("FBX", ".fbx", _ASSIMP)),
        *(("LightWave", ".lwo", _ASSIMP), ("Draco", ".drc", "draco_decoder -i scan{0} -o scan.ply")),
        ("VTK collection", ".vtm .pvd", _PYTHON.format("pyvista", _PYVISTA % "combine().")),
        ("VTK data set", ".pvtu .pvtp .vti .vts .vtr .vtkhdf", _PYTHON.format("pyvista", _PYVISTA % "")),
        ("tar", ".tar .tgz", "tar -xf scan{0}"),
        *(("zip", ".zip", "unzip scan{0}"), ("bzip2", ".bz2", "bunzip2 scan{0}"), ("xz", ".xz", "unxz scan{0}")),
    )
    for suffix in suffixes.split()
}


def mesh_format(path: PurePath) -> str:
    """Return the suffix in lower case and without .gz, or the name of a format without suffixes."""
    name = _unpacked_name(path).lower()
    suffix = Path(name).suffix
    if suffix in BY_SUFFIX or suffix in CONVERTED:
        return suffix
    return next((form.suffixes[0] for form in BY_SUFFIX.values() if form.is_name and form.is_name(name)), suffix)


def is_mesh_name(path: Path) -> bool:
    """Return whether a file has the name of a mesh in a format that is read."""
    return mesh_format(path) in BY_SUFFIX


def mesh_stem(path: PurePath) -> str:
    """Return the name of a file without its format and compression; names of formats without a suffix are all stem."""
    name, form = _unpacked_name(path), BY_SUFFIX.get(mesh_format(path))
    return name if form and form.is_name else Path(name).stem


def _unpacked_name(path: PurePath) -> str:
    return path.name[: -len(".gz")] if is_gzipped(path) else path.name
