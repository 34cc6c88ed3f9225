# The classes of what functions return: each is imported from its module when it is first asked for.
from .batch.dry_run import ObjectPlan as ObjectPlan
from .batch.dry_run import StudyPlan as StudyPlan
from .batch.reduce import Reduction as Reduction
from .batch.run import Summary as Summary
from .batch.status import Status as Status
from .batch.submit import Submission as Submission
from .batch.verify import Verification as Verification
from .extras.draft import StudyDraft as StudyDraft
from .extras.leagues.costs import CostLeague as CostLeague
from .extras.leagues.league import League as League
from .tables.store_accessor import StoreAccessor as StoreAccessor

__all__: list[str]
