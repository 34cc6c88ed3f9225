# The public names of this package: each is imported from its module when it is first asked for.
from .align import align as align
from .derivatives import SquaredDistance as SquaredDistance
from .derivatives import gradient as gradient
from .fit import Fit as Fit
from .fit import FitProgress as FitProgress
from .fit import FitQuality as FitQuality
from .fit import refine as refine

__all__: list[str]
DEFAULT_STEPS: int
DEFAULT_SMOOTHING: float
