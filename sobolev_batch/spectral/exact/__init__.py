"""Exact transforms: closed forms of triangles and spheres, which quadrature is checked against.

In: a surface and a few frequencies. Out: its Fourier transform to rounding.
"""
