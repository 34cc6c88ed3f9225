"""Shapes: meshes and surfaces by formula, with their extents and similarity transforms.

In: arrays of vertices and triangles, or a formula. Out: frozen surfaces that everything else reads.
"""
