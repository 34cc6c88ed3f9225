"""Meshes: the surfaces of a study made again, coloured by what a store says of them.

In: a store and its study. Out: PLY and VTK files, and pictures drawn off screen.
"""
