"""Files such as the readers of docs/walkthroughs.md have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import fast_simplification
import nibabel
import numpy as np

import sobolev_batch as sb

SIZES = (40, 80, 160, 320, 640)


def bumps(mesh: sb.Mesh, height: float, frequency: float = 5.0) -> sb.Mesh:
    """Return a mesh around the origin whose radius goes up and down."""
    vertices = np.asarray(mesh.vertices)
    radii = 1 + height * np.sin(frequency * vertices[:, :1]) * np.cos(frequency * vertices[:, 1:2])
    return sb.Mesh(radii * vertices, mesh.triangles)


def decimated(mesh: sb.Mesh, triangles: int, aggression: float = 7.0) -> sb.Mesh:
    """Return a mesh with fewer triangles, by quadric errors."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int32)
    return sb.Mesh(*fast_simplification.simplify(vertices, faces, target_count=triangles, agg=aggression))


def rough(mesh: sb.Mesh, share: float, seed: int = 0) -> sb.Mesh:
    """Return a mesh with noise of a share of its largest coordinate."""
    vertices = np.asarray(mesh.vertices)
    noise = np.random.default_rng(seed).normal(scale=share * np.abs(vertices).max(), size=vertices.shape)
    return sb.Mesh(vertices + noise, mesh.triangles)


def shrunk(mesh: sb.Mesh, factor: float) -> sb.Mesh:
    """Return a mesh scaled about the origin."""
    return sb.Mesh(factor * np.asarray(mesh.vertices), mesh.triangles)


def write(mesh: sb.Mesh, path: Path) -> None:
    """Write a mesh, into a folder that may not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sb.write_mesh(mesh, path)


def remeshers(folder: Path) -> None:
    """Four objects, five methods, five sizes, and new meshes of one method."""
    objects = {
        "egg": sb.Ellipsoid((1.0, 0.8, 0.6)).mesh(3),
        "torus": sb.Torus().mesh(36, 18),
        "bumps": bumps(sb.icosphere(3), 0.1),
        "bean": sb.Mesh(
            np.asarray(sb.icosphere(3).vertices) ** 3 + sb.icosphere(3).vertices, sb.icosphere(3).triangles
        ),
    }
    methods: dict[str, Callable[[sb.Mesh, int], sb.Mesh]] = {
        "mine": lambda mesh, count: rough(decimated(mesh, count), 0.01),
        "quick": lambda mesh, count: decimated(mesh, count, 9.0),
        "careful": lambda mesh, count: decimated(mesh, count, 3.0),
        "noisy": lambda mesh, count: rough(decimated(mesh, count), 0.03),
        "shrinking": lambda mesh, count: shrunk(decimated(mesh, count), 0.97),
    }
    for name, mesh in objects.items():
        write(mesh, folder / "remeshers" / "objects" / f"{name}.ply")
        for count in SIZES:
            for method, make in methods.items():
                write(make(mesh, count), folder / "remeshers" / "out" / method / f"{name}_{count}.ply")
            write(decimated(mesh, count), folder / "new" / "mine" / f"{name}_{count}.ply")


def brains(folder: Path) -> None:
    """Two surfaces of each of three subjects, in millimetres, as FreeSurfer writes them."""
    for number, noise in (("01", 0.002), ("02", 0.004), ("03", 0.02)):
        surface = bumps(sb.icosphere(3), 0.1, 8.0 + int(number))
        for scan, mesh in (("scan", surface), ("rescan", rough(surface, noise))):
            path = folder / "brains" / f"s{number}" / scan / "lh.pial"
            path.parent.mkdir(parents=True)
            nibabel.freesurfer.write_geometry(path, 90 * np.asarray(mesh.vertices), mesh.triangles)


def scans(folder: Path) -> None:
    """A part, two hundred scans of it, and ten more."""
    part = sb.Torus().mesh(24, 12)
    write(part, folder / "scans" / "part.ply")
    for number in range(210):
        place = "scans" if number < 200 else "later"
        write(rough(part, 0.001 * (1 + number % 7), number), folder / "scans" / place / f"scan_{number:03}.ply")


def statue(folder: Path) -> None:
    """A mesh and a simpler one."""
    whole = bumps(sb.icosphere(4), 0.15)
    write(whole, folder / "statue.ply")
    write(decimated(whole, 500), folder / "simple.ply")


def part(folder: Path) -> None:
    """A fine tessellation in millimetres, coarser ones, and one in inches."""
    ring = sb.Torus(40.0, 12.0)
    write(ring.mesh(144, 72), folder / "part" / "part.stl")
    for name, cells in (("rough", 16), ("middle", 32), ("fine", 96)):
        write(ring.mesh(cells, cells // 2), folder / "part" / "exported" / f"{name}.stl")
    write(shrunk(ring.mesh(96, 48), 1 / 25.4), folder / "part" / "inches.stl")


FILES: dict[str, Callable[[Path], None]] = {
    "A remesher against others": remeshers,
    "Surfaces of brains": brains,
    "Two hundred scans on a cluster": scans,
    "A first look at two meshes": statue,
    "A part in millimetres": part,
}
