"""Exact transforms: closed forms of triangles and spheres, to check computed fields against.

In: a surface and a few frequencies, or two spheres. Out: Fourier transforms and norms, exact to rounding.
"""
