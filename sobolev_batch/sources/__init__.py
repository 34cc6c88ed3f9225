"""Sources: families of surfaces by their parameters; with what a package needs that brings sources of its own.

In: the tables of a study file. Out: members, each of which travels to a worker and makes its surface there.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
