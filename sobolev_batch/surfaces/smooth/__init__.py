"""Smooth surfaces: ellipsoids, tori, and any x(u, v) over intervals.

In: parameters and formulas. Out: frozen surfaces with points, area elements and bounds over their parameters.
"""
