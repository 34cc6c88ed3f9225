# The public names of this package: each is imported from its module when it is first asked for.
from .conformance import check_source as check_source
from .registry import ExpectedSize as ExpectedSize
from .registry import Member as Member
from .registry import Source as Source
from .registry import SurfaceMember as SurfaceMember

__all__: list[str]
