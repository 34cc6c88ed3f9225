"""The exceptions of the package: one tree, plain messages, safe to pickle between processes."""


class SobolevBatchError(Exception):
    """Base of every error that the package raises on purpose.

    Each takes one message, and nothing else, so that it survives the trip from a worker to the
    client. The message names the file or mesh, what was found, what was expected, what to do.
    """


class InputError(SobolevBatchError):
    """What the caller handed over is wrong; computing again would not help."""


class MeshError(InputError):
    """A mesh, or the file that should hold one, is not usable."""


class LatticeError(InputError):
    """A lattice is malformed, or a surface does not fit into its period."""


class OrderError(InputError):
    """A Sobolev order for which the norm of a surface measure is infinite."""


class StudyError(InputError):
    """A study file is malformed or asks for something that does not exist."""


class StoreError(InputError):
    """A store cannot be read or written, or belongs to another study."""


class ClusterError(SobolevBatchError):
    """The Dask cluster cannot be reached or stopped serving."""
