"""Sobolev distances of negative order between surface meshes, for thousands of meshes at once.

A study file names families of meshes, a reference and a frequency lattice. Each mesh becomes a Dask
task; a reduction over the stored fields makes the tables. Data flows one way through the folders:

    surfaces   study file -> sources -> Mesh or closed-form surface -> one similarity transform
    spectral   -> weighted points, in batches -> NUFFT -> a block of the Fourier field
    fitting    -> derivatives of distances, meshes that come nearer to a target
    batch      -> zarr store -> norms, distances, convergence (a study as tasks on a cluster)
    results    -> tables, plots, a report, a lazy DataTree
    testing    -> verdicts on two surfaces, for test suites

`surfaces` imports none of the others; `spectral` and `fitting` import neither dask nor zarr. See docs/design.md.

The public names by subject:

- Numbers with their errors, of surfaces and of fields: `distance`, `norm`.
- The causes of a distance: `spectrum` (wavelengths), `witness` (places).
- Meshes made by the metric: `fit` and `refine` give a `Fit`, with its `FitQuality` before and after, and `FitProgress`
  on the way; `gradient` and `SquaredDistance` are for optimisers of your own, `torch_function` and `jax_function` for
  tensors.
- Fields: `fourier_transform` on a `Lattice`; all of the above are methods of `field.sobolev`, see `SobolevAccessor`.
- Surfaces: `Mesh`, `as_mesh` (of paths, arrays and other libraries' meshes), `read_mesh`, `write_mesh`, `icosphere`,
  `Sphere`, `Ellipsoid`, `Torus`, `ParametrisedSurface` over two `Interval`; a
  `Similarity` scales and moves them.
- Sources of your own: `Source`, `Member`, `SurfaceMember` and `ExpectedSize`, checked by `check_source`.
- Test suites: `assert_same_surface`, or `same_surface` for its `Verdict`.
- For orientation: `proximity` of two meshes, a `Proximity` (Hausdorff, Chamfer).
- Studies: `Study`, `StudyCollection`; `plan` and its `StudyPlan` or `CollectionPlan`, `run` and its `Summary`,
  `submit` and its `Submission`.
- Stores: `open_store`, `status` and its `Status`, `verify` and its `Verification`, `release`.
- Results of a store: `table`, `matrix`, `evolution` (over time), `report`, `write_witness`; on Matplotlib axes:
  `plot`, `plot_league`, `plot_witness`.
- Errors: all derive from `SobolevBatchError`.
"""

from importlib import import_module  # noqa: TID251 -- of modules of this package
from typing import Any

import lazy_loader

# All modules together take seconds to import, in which the command line could not answer.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# xarray learns of the accessors `field.sobolev` and `tree.sobolev` with the first function that returns fields.
_RETURN_FIELDS = ("fourier_transform", "open_store")


def __getattr__(name: str) -> Any:
    if name in _RETURN_FIELDS:
        import_module(f"{__name__}.results.accessor")
    if name == "open_store":
        import_module(f"{__name__}.results.store_accessor")
    return _load(name)
