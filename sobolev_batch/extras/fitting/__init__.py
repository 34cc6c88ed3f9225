"""Meshes made by the metric: the derivative of squared distances, and meshes that come nearer.

In: meshes, and surfaces or fields as their targets. Out: gradients, fitted meshes and reports about them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Here, as the command line shows them without importing what computes.
DEFAULT_STEPS, DEFAULT_SMOOTHING = 150, 0.25
