"""Spectral: Fourier transforms of surfaces on a lattice, and norms of them with their errors.

In: surfaces, a lattice or a tolerance. Out: fields, norms and distances. Knows neither dask nor zarr.
"""
