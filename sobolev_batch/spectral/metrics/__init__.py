"""Metrics: norms, inner products, distances, and what is behind a distance.

In: fields, or surfaces that become fields. Out: xarray datasets over orders, frequencies or points.
"""
