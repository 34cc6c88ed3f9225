"""Shapes: meshes and spheres, with their extents and similarity transforms.

In: arrays of vertices and triangles, or a radius. Out: frozen surfaces that everything else reads.
"""
