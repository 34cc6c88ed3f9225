"""Squared distances of a mesh as functions of its vertices, with their derivatives.

In: meshes, and surfaces or fields as their targets. Out: gradients, functions for optimisers, tensors.
"""
