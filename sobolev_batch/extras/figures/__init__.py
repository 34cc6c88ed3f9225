"""Figures: plots of a store, and its meshes, made again and coloured by their witness functions.

In: tables, spectra and fields. Out: Matplotlib figures, pictures, PLY and VTK files.
"""
