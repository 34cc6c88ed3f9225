"""Metrics of fields: norms, distances, spectra, decompositions, witness functions.

In: fields, or surfaces with a lattice or a tolerance. Out: labelled datasets in which numbers have their errors.
"""
