"""Testing: is this surface the same as that one, to a tolerance, or as near everywhere as a length?

In: two surfaces and a tolerance. Out: a verdict, an assertion of test suites, and files that show where they differ.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
