# The public modules of this folder, imported when they are first asked for.
from . import fitting as fitting
from . import plot as plot

__all__: list[str]
