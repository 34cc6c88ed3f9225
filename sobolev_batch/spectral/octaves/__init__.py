"""Octaves: what lies beyond a lattice, measured on random lattices and at drawn frequencies.

In: surfaces, octaves of |ξ|, a seed. Out: integrals over each octave with standard errors, for any order.
"""
