"""Transform: from a surface to a block of its Fourier field, within the memory that is allowed.

In: a surface, a lattice, a block, settings. Out: complex values, the number of points, the backend.
"""
