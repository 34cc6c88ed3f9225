"""Quadrature: surfaces become weighted points, as few as a tolerance permits.

In: a mesh or a parametrised surface, the highest frequency, a tolerance. Out: weighted points in batches.
"""
