"""Fields: one Dask task, or a graph of them, for the Fourier field of each mesh.

In: a plan and a store. Out: stored fields and a completion record for each mesh.
"""
