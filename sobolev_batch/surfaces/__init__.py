"""Surfaces: meshes and closed forms, with their readers, sources and similarity transforms.

In: mesh files, arrays, formulas, or the tables of a study file. Out: frozen surfaces for `spectral` and `batch`.
"""
