"""Backends: the NUFFT on a processor or a GPU, the arrays of either, and what they cost.

In: points and strengths. Out: modes of a plan, in arrays of the same backend.
"""
