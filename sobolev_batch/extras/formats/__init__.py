"""Formats that are read rarely, and only read.

In: glTF, GIFTI, FreeSurfer, VTK, 3MF, Medit and Gmsh files. Out: vertices and triangles.
"""
