"""Norms: from fields to norms and distances of every order, each with its error.

In: surfaces, a lattice or a tolerance. Out: labelled datasets, numbers with errors. Knows neither dask nor zarr.
"""

# Of all functions, commands and studies that name none; here, where the command line need not import what computes.
DEFAULT_ORDER = -2.0
