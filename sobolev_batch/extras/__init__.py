"""Extras: what draws, ranks, fits, and reads rare formats. The rest of the package works without this folder.

In: stores, meshes, surfaces. Out: plots, reports, leagues, fitted meshes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
