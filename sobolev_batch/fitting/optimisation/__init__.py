"""Descent of a squared distance over the vertices of a mesh.

In: a mesh and the field of its target. Out: moved vertices, and why they move no further.
"""
