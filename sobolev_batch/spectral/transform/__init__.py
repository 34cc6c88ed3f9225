"""Transform: weighted points become a block of the Fourier field, within a given memory.

In: a surface, a block of the lattice, settings. Out: complex values on the block.
"""
