"""Sources: families of surfaces, listed without making any.

In: the table of a source in a study file. Out: members, small values that a worker makes into surfaces.
"""
