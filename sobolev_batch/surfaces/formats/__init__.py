"""Formats: readers of mesh files that check every count before they believe it.

In: the path of a PLY, OBJ, STL, OFF, glTF or GIFTI file. Out: a `Mesh`, or an error that names the file.
"""
