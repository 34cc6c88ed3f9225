"""What the package costs, against the pipeline of K. Koga's paper and against bare arithmetic.

`python -m benchmarks` prints one table of ratios. Two contestants always take turns, and a ratio is
that of their median times, so that a machine whose speed drifts treats both alike.
"""
