"""Tail: what lies beyond a lattice, measured on octaves of |ξ| and from pairs of close points.

In: surfaces, octaves, a seed. Out: integrals over each octave and beyond the last, with standard errors, of any order.
"""
