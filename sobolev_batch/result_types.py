"""Result types: the classes of what functions return, for annotations; importing them registers both accessors."""

from sobolev_batch.batch.run import Summary
from sobolev_batch.batch.study.draft import StudyDraft
from sobolev_batch.batch.submit import Submission
from sobolev_batch.batch.verify import Verification
from sobolev_batch.results.accessor import SobolevAccessor
from sobolev_batch.results.plan import CollectionPlan, StudyPlan
from sobolev_batch.results.status import Status
from sobolev_batch.results.store_accessor import StoreAccessor
from sobolev_batch.results.tables.costs import CostLeague
from sobolev_batch.results.tables.league import League

__all__ = [
    "CollectionPlan",
    "CostLeague",
    "League",
    "SobolevAccessor",
    "Status",
    "StoreAccessor",
    "StudyDraft",
    "StudyPlan",
    "Submission",
    "Summary",
    "Verification",
]
