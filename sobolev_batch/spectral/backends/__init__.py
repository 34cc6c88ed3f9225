"""Backends: the NUFFT on the processor or on a GPU, the arrays of each, and the costs of both.

In: the specification of a NUFFT, points, strengths. Out: Fourier modes, in arrays of the same backend.
"""
