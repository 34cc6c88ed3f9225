"""Errors of fields, norms and distances: predicted before a computation, measured after it.

In: fields, their sums and a few exact values. Out: truncation, aliasing and discretisation errors.
"""
