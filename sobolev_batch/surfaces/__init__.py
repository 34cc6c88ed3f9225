"""Surfaces: meshes, closed forms and point clouds, with their readers, sources and similarity transforms.

In: mesh files, arrays, formulas, or the tables of a study file. Out: frozen surfaces for `spectral` and `batch`.
"""
