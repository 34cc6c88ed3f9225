"""Transform: Fourier transforms of surfaces on blocks of a lattice, with what to expect of their errors.

In: surfaces, a lattice, settings. Out: arrays of values on the processor or on a GPU. Knows neither dask nor zarr.
"""
