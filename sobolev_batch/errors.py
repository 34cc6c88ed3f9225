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


class AccuracyError(InputError):
    """An accuracy is out of reach within the memory that may be used.

    Attributes:
        requested: the rtol that was asked for.
        reachable: the smallest one that is expected to be met.
    """

    def __init__(self, message: str, requested: float, reachable: float) -> None:
        super().__init__(message, requested, reachable)
        self.requested = requested
        self.reachable = reachable

    def __str__(self) -> str:
        return str(self.args[0])


class StudyError(InputError):
    """A study file is malformed or asks for something that does not exist."""


class StoreError(InputError):
    """A store cannot be read or written, or belongs to another study."""


class LockError(StoreError):
    """Another run holds the lock on a store."""


# The name of earlier versions.
ClaimError = LockError


class DamageError(StoreError):
    """What is stored is not what was stored.

    Attributes:
        what: is wrong, without saying with what.
        row: of the field, where it is one.
    """

    def __init__(self, message: str, what: str, row: int | None = None) -> None:
        super().__init__(message, what, row)
        self.what = what
        self.row = row

    def __str__(self) -> str:
        return str(self.args[0])


class BackendError(SobolevBatchError):
    """A GPU was asked for and cannot be used: a library, the driver or the device is missing or fails."""


class ClusterError(SobolevBatchError):
    """The Dask cluster cannot be reached or stopped serving."""


class AddressError(ClusterError, InputError):
    """The address of a scheduler is malformed, or its network is not to be trusted."""
