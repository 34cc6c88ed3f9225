"""VTK's files of surfaces, in its legacy and XML formats.

In: the bytes of a .vtk, .vtp or .vtu file. Out: vertices and triangles, or an error. VTK itself is not needed.
"""
