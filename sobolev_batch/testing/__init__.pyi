# The public names of this package: each is imported from its module when it is first asked for.
from .verdict import Verdict as Verdict
from .verdict import assert_same_surface as assert_same_surface
from .verdict import same_surface as same_surface
from .within import assert_within as assert_within

__all__: list[str]
