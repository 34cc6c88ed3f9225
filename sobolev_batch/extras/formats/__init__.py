"""Formats that are read rarely, and only read.

In: glTF, GIFTI, FreeSurfer and VTK files. Out: vertices and triangles.
"""
