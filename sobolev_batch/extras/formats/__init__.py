"""Formats that are read rarely.

In: glTF, GIFTI, FreeSurfer, VTK, 3MF, Medit and Gmsh files. Out: vertices and triangles.
"""
