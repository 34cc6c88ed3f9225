"""Result types: the classes of what functions return, for annotations; importing them registers the accessor."""

from typing import Any

import lazy_loader

# They register themselves with xarray.
from sobolev_batch.tables import store_accessor  # noqa: F401

# Each class is imported when it is first asked for, those of the extras only where these are installed.
_load, __dir__, __all__ = lazy_loader.attach_stub("sobolev_batch", __file__)


def __getattr__(name: str) -> Any:
    # What reads the documentation of a module looks at what it holds.
    value = globals()[name] = _load(name)
    return value
