"""Formats: readers of mesh files that check every count before they believe it.

In: the path of a PLY, OBJ, STL or OFF file, or one that an extra reads, or a mesh of another library. Out: a `Mesh`, or
an error that names the file or the type. Parsers refuse by a `MeshError`, and `read_mesh` puts the path before it.
"""
