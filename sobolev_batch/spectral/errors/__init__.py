"""Errors: what a field, a norm or a distance may be wrong by, predicted before and measured after.

In: fields, their sums and a few exact values. Out: truncation, aliasing and discretisation errors.
"""
