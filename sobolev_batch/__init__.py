"""Sobolev distances of negative order between surface meshes, for thousands of meshes at once.

A study file names families of meshes, a reference and a frequency lattice. Each mesh becomes a Dask
task; a reduction over what the tasks stored makes the tables. Data flows one way through four rooms:

    surfaces   study file -> sources -> Mesh or closed-form surface -> one similarity transform
    spectral   -> weighted points, in batches -> NUFFT -> a block of the Fourier field
    batch      -> zarr store -> norms, distances, convergence (a study as tasks on a cluster)
    results    -> what people read: tables, plots, a lazy DataTree

`surfaces` knows none of the others, `spectral` knows neither dask nor zarr. See docs/design.md.

What there is:

- Numbers with their errors, of surfaces and of fields: `distance`, `norm`, `inner_product`.
- What is behind a distance: `proportion` (area or shape), `spectrum` (wavelengths), `witness` (places).
- Fields: `fourier_transform` on a `Lattice`; all of the above are methods of `field.sobolev`, see `SobolevAccessor`.
- Surfaces: `Mesh`, `read_mesh`, `icosphere`, `Sphere`, `Ellipsoid`, `Torus`, `ParametrisedSurface` over two
  `Interval`; a `Similarity` scales and moves them.
- Sources of your own: `Source`, `Member`, `SurfaceMember` and `ExpectedSize`, checked by `check_source`.
- For orientation: `proximity` of two meshes, a `Proximity` (Hausdorff, Chamfer).
- Studies: `Study`, `run` and its `Summary`, `submit` and its `Submission`.
- Stores: `open_store`, `write_witness`, `verify` and its `Verification`, `release`.
- Errors: all derive from `SobolevBatchError`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sobolev_batch.batch.run import Summary, run
    from sobolev_batch.batch.store.release import release
    from sobolev_batch.batch.study.study import Study
    from sobolev_batch.batch.submit import Submission, submit
    from sobolev_batch.batch.verify import Verification, verify
    from sobolev_batch.errors import (
        AccuracyError,
        AddressError,
        BackendError,
        ClaimError,
        ClusterError,
        DamageError,
        InputError,
        LatticeError,
        MeshError,
        OrderError,
        SobolevBatchError,
        StoreError,
        StudyError,
    )
    from sobolev_batch.results.accessor import SobolevAccessor
    from sobolev_batch.results.meshes.export import write_witness
    from sobolev_batch.results.open import open_store
    from sobolev_batch.spectral.fields import fourier_transform
    from sobolev_batch.spectral.lattice import Lattice
    from sobolev_batch.spectral.metrics.decomposition import proportion
    from sobolev_batch.spectral.metrics.norms import distance, inner_product, norm
    from sobolev_batch.spectral.metrics.spectrum import spectrum
    from sobolev_batch.spectral.metrics.witness import witness
    from sobolev_batch.surfaces.formats.readers import read_mesh
    from sobolev_batch.surfaces.proximity import Proximity, proximity
    from sobolev_batch.surfaces.shapes.ellipsoid import Ellipsoid
    from sobolev_batch.surfaces.shapes.icosphere import icosphere
    from sobolev_batch.surfaces.shapes.interval import Interval
    from sobolev_batch.surfaces.shapes.mesh import Mesh
    from sobolev_batch.surfaces.shapes.parametrised import ParametrisedSurface
    from sobolev_batch.surfaces.shapes.similarity import Similarity
    from sobolev_batch.surfaces.shapes.sphere import Sphere
    from sobolev_batch.surfaces.shapes.torus import Torus
    from sobolev_batch.surfaces.sources.conformance import check_source
    from sobolev_batch.surfaces.sources.registry import ExpectedSize, Member, Source, SurfaceMember

__all__ = [
    "AccuracyError",
    "AddressError",
    "BackendError",
    "ClaimError",
    "ClusterError",
    "DamageError",
    "Ellipsoid",
    "ExpectedSize",
    "InputError",
    "Interval",
    "Lattice",
    "LatticeError",
    "Member",
    "Mesh",
    "MeshError",
    "OrderError",
    "ParametrisedSurface",
    "Proximity",
    "Similarity",
    "SobolevAccessor",
    "SobolevBatchError",
    "Source",
    "Sphere",
    "StoreError",
    "Study",
    "StudyError",
    "Submission",
    "Summary",
    "SurfaceMember",
    "Torus",
    "Verification",
    "check_source",
    "distance",
    "fourier_transform",
    "icosphere",
    "inner_product",
    "norm",
    "open_store",
    "proportion",
    "proximity",
    "read_mesh",
    "release",
    "run",
    "spectrum",
    "submit",
    "verify",
    "witness",
    "write_witness",
]


# Modules are imported when something of them is asked for: it takes seconds for all of them, in which
# the command line could not answer.
_MODULES = {
    "AccuracyError": "errors",
    "AddressError": "errors",
    "BackendError": "errors",
    "ClaimError": "errors",
    "ClusterError": "errors",
    "DamageError": "errors",
    "Ellipsoid": "surfaces.shapes.ellipsoid",
    "ExpectedSize": "surfaces.sources.registry",
    "InputError": "errors",
    "Interval": "surfaces.shapes.interval",
    "Lattice": "spectral.lattice",
    "LatticeError": "errors",
    "Member": "surfaces.sources.registry",
    "Mesh": "surfaces.shapes.mesh",
    "MeshError": "errors",
    "OrderError": "errors",
    "ParametrisedSurface": "surfaces.shapes.parametrised",
    "Proximity": "surfaces.proximity",
    "Similarity": "surfaces.shapes.similarity",
    "SobolevAccessor": "results.accessor",
    "SobolevBatchError": "errors",
    "Source": "surfaces.sources.registry",
    "Sphere": "surfaces.shapes.sphere",
    "StoreError": "errors",
    "Study": "batch.study.study",
    "StudyError": "errors",
    "Submission": "batch.submit",
    "Summary": "batch.run",
    "SurfaceMember": "surfaces.sources.registry",
    "Torus": "surfaces.shapes.torus",
    "Verification": "batch.verify",
    "check_source": "surfaces.sources.conformance",
    "distance": "spectral.metrics.norms",
    "fourier_transform": "spectral.fields",
    "icosphere": "surfaces.shapes.icosphere",
    "inner_product": "spectral.metrics.norms",
    "norm": "spectral.metrics.norms",
    "open_store": "results.open",
    "proportion": "spectral.metrics.decomposition",
    "proximity": "surfaces.proximity",
    "read_mesh": "surfaces.formats.readers",
    "release": "batch.store.release",
    "run": "batch.run",
    "spectrum": "spectral.metrics.spectrum",
    "submit": "batch.submit",
    "verify": "batch.verify",
    "witness": "spectral.metrics.witness",
    "write_witness": "results.meshes.export",
}
# What makes or opens fields registers their accessor `field.sobolev` with xarray, which would be too much
# for the import of the package.
_FIELD_MAKERS = ("fourier_transform", "open_store")


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _FIELD_MAKERS:
        import_module(f"{__name__}.{_MODULES['SobolevAccessor']}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
