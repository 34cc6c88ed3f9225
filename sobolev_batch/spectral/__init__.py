"""Spectral: Fourier transforms of surfaces on a lattice, and norms of them with their errors.

In: surfaces, a lattice or a tolerance. Out: fields, norms and distances. Knows neither dask nor zarr.
"""

# Of every function, command and study that names none. Here, as the command line shows it without importing what
# computes.
DEFAULT_ORDER = -2.0
