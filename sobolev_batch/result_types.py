"""Result types: the classes of what functions return, for annotations; importing them registers both accessors."""

from sobolev_batch.batch.dry_run import CollectionPlan, StudyPlan
from sobolev_batch.batch.run import Summary
from sobolev_batch.batch.status import Status
from sobolev_batch.batch.submit import Submission
from sobolev_batch.batch.verify import Verification
from sobolev_batch.extras.draft import StudyDraft
from sobolev_batch.extras.leagues.costs import CostLeague
from sobolev_batch.extras.leagues.league import League
from sobolev_batch.tables.accessor import SobolevAccessor
from sobolev_batch.tables.store_accessor import StoreAccessor

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
