"""Analysis: what is computed from stored fields, as tasks of its own.

In: complete fields. Out: norms, distances, convergence, witness functions and proximities, as tables.
"""
