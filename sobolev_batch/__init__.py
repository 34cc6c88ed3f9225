"""Sobolev distances of negative order between surface meshes, for thousands of meshes at once.

A study file names families of meshes, a reference and a frequency lattice. Each mesh becomes a Dask
task; a reduction over what the tasks stored makes the tables. Data flows one way through four rooms:

    surfaces   study file -> sources -> Mesh or closed-form surface -> one similarity transform
    spectral   -> weighted points, in batches -> NUFFT -> a block of the Fourier field
    batch      -> zarr store -> norms, distances, convergence (a study as tasks on a cluster)
    results    -> what people read: tables, plots, a lazy DataTree

`surfaces` knows none of the others, `spectral` knows neither dask nor zarr. See docs/design.md.
"""

from sobolev_batch.batch.run import Summary, run
from sobolev_batch.batch.study import Study
from sobolev_batch.batch.submission import Submission, submit
from sobolev_batch.errors import (
    AccuracyError,
    AddressError,
    BackendError,
    ClusterError,
    InputError,
    LatticeError,
    MeshError,
    OrderError,
    SobolevBatchError,
    StoreError,
    StudyError,
)
from sobolev_batch.results.opening import open_store
from sobolev_batch.spectral.fields import fourier_transform
from sobolev_batch.spectral.lattice import Lattice
from sobolev_batch.spectral.norms import distance, inner_product, norm
from sobolev_batch.surfaces.icosphere import icosphere
from sobolev_batch.surfaces.mesh import Mesh
from sobolev_batch.surfaces.readers import read_mesh
from sobolev_batch.surfaces.similarity import Similarity
from sobolev_batch.surfaces.sphere import Sphere

__all__ = [
    "AccuracyError",
    "AddressError",
    "BackendError",
    "ClusterError",
    "InputError",
    "Lattice",
    "LatticeError",
    "Mesh",
    "MeshError",
    "OrderError",
    "Similarity",
    "SobolevBatchError",
    "Sphere",
    "StoreError",
    "Study",
    "StudyError",
    "Submission",
    "Summary",
    "distance",
    "fourier_transform",
    "icosphere",
    "inner_product",
    "norm",
    "open_store",
    "read_mesh",
    "run",
    "submit",
]
