"""Figures: plots of a store.

In: tables and spectra. Out: Matplotlib figures and files.
"""
