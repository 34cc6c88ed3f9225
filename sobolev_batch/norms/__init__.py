"""Norms: from fields to norms and distances of every order, each with its error.

In: surfaces, a lattice or a tolerance. Out: labelled datasets in which numbers have their errors. Knows neither dask
nor zarr.
"""

# Of every function, command and study that names none. Here, as the command line shows it without importing what
# computes.
DEFAULT_ORDER = -2.0
