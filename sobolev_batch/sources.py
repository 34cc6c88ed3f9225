"""Sources: what a package needs that brings families of surfaces for studies, and the test of them."""

from sobolev_batch.surfaces.sources.conformance import check_source
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Member, Source, SurfaceMember

__all__ = ["ExpectedSize", "Member", "Source", "SurfaceMember", "check_source"]
