"""Accuracy: a relative tolerance becomes a lattice and settings that meet it.

In: surfaces, orders, a tolerance. Out: numbers that meet it, or an `AccuracyError` with the reachable tolerance.
"""
