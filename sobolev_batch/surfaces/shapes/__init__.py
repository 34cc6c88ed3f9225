"""Shapes: meshes and surfaces given by formulas, with their extents and similarity transforms.

In: arrays of vertices and triangles, or parameters. Out: frozen surfaces that everything else reads.
"""
