"""Numbers only: lattices, quadrature, the NUFFT primitive, exact transforms, norms. Knows neither dask nor zarr."""
