"""Analysis: what is computed from stored fields, as tasks of its own.

In: complete fields. Out: norms, distances, convergence, Hausdorff and Chamfer distances, as tables.
"""
