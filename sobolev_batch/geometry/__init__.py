"""Geometry: meshes and surfaces by formula, what two of them have in common, and distances between their points.

In: arrays, files, formulas. Out: frozen surfaces, and numbers that need no transform.
"""
