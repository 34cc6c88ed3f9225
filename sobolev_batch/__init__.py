"""Sobolev distances of negative order between surface meshes, for thousands of meshes at once.

A study file names objects, each with a reference, families of meshes for all of them, and an accuracy or a frequency
lattice. Dask's workers plan the objects and transform their meshes; a reduction over the stored fields makes the
tables. Data flows one way through the folders, which docs/design.md lists.

The public names by subject:

- Numbers with their errors, of surfaces and of fields: `distance`, `norm`; of a sequence of meshes, with observed
  rates: `convergence`. Their causes: `spectrum` (wavelengths), `witness` (places). For orientation: `yardsticks`,
  `largest_deviation` (between bounds), `proximity` (Hausdorff, Chamfer) and `vertex_distances`.
- Meshes: `Mesh`, `as_mesh` (of paths, arrays and other libraries' meshes), `read_mesh`, `write_mesh`; `fit` moves the
  vertices of one towards a target.
- Fields: `fourier_transform` on a `Lattice`.
- Studies: `Study`, `init_study`, `plan`, `run`, `submit`.
- Stores: `open_store`, `status`, `verify`, `unlock`.
- Meshes within a tolerance: `reduce`.
- Results of a store: `table`, `smallest_below`, `matrix`, `evolution` (over time), `league`, `compare_studies`,
  `report`, `write_witness`.
- Modules: `plot` (on Matplotlib axes), `shapes` (spheres and surfaces of your own), `fitting` (refinement and
  derivatives), `sources` (of your own, for studies), `testing` (assertions), `result_types` (classes of what
  functions return), `errors`.
"""

from importlib import import_module, metadata  # noqa: TID251 -- of modules of this package
from typing import Any

import lazy_loader

# All modules together take seconds to import, in which the command line could not answer.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("sobolev-batch")
    if name == "open_store":
        # xarray learns of the accessor `tree.sobolev`.
        import_module(f"{__name__}.tables.store_accessor")
    return _load(name)
