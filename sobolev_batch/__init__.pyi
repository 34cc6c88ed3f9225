# The public API: each name is imported from its module when it is first asked for.
from . import errors as errors
from . import result_types as result_types
from . import shapes as shapes
from . import sources as sources
from . import testing as testing
from .batch.dry_run import plan as plan
from .batch.reduce import reduce as reduce
from .batch.run import run as run
from .batch.status import status as status
from .batch.submit import submit as submit
from .batch.verify import verify as verify
from .extras import fitting as fitting
from .extras import plot as plot
from .extras.draft import init_study as init_study
from .extras.figures.remade import write_witness as write_witness
from .extras.fitting.fit import fit as fit
from .extras.leagues.changes import compare_studies as compare_studies
from .extras.leagues.evolution import evolution as evolution
from .extras.leagues.league import league as league
from .extras.report.build import report as report
from .geometry.deviation import largest_deviation as largest_deviation
from .geometry.formats.conversion import as_mesh as as_mesh
from .geometry.formats.readers import read_mesh as read_mesh
from .geometry.formats.writing import write_mesh as write_mesh
from .geometry.mesh import Mesh as Mesh
from .geometry.proximity import proximity as proximity
from .geometry.proximity import vertex_distances as vertex_distances
from .norms.causes import spectrum as spectrum
from .norms.causes import witness as witness
from .norms.distances import distance as distance
from .norms.distances import norm as norm
from .norms.fields import fourier_transform as fourier_transform
from .norms.rates import convergence as convergence
from .norms.yardsticks import yardsticks as yardsticks
from .store.latest_run import unlock as unlock
from .study.study import Study as Study
from .tables.convergence import table as table
from .tables.matrix import matrix as matrix
from .tables.open import open_store as open_store
from .tables.smallest import smallest_below as smallest_below
from .transform.lattice import Lattice as Lattice

__all__: list[str]
__version__: str
