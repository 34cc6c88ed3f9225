"""Meshes made by the metric: the derivative of squared distances, and meshes that come nearer.

In: meshes, and surfaces or fields as their targets. Out: gradients, fitted meshes and reports about them.
"""
