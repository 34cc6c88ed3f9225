"""Shapes: meshes, spheres and point clouds, with their extents and similarity transforms.

In: arrays of vertices and triangles, of points and areas, or a radius. Out: frozen surfaces that everything else reads.
"""
