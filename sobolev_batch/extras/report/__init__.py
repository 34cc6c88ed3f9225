"""Report: one HTML page with everything that a store holds.

In: a store. Out: a file that opens without a network.
"""
