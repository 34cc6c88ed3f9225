"""The assertion of test suites that two surfaces are the same."""

from __future__ import annotations

from pathlib import Path

from sobolev_batch.errors import SobolevBatchError, one_line
from sobolev_batch.surfaces.formats.objects import SurfaceLike, as_surface
from sobolev_batch.testing.defaults import DEFAULT_ORDER, DEFAULT_RTOL
from sobolev_batch.testing.verdict import Verdict, same_surface
from sobolev_batch.testing.witness import write_difference


def assert_same_surface(
    a: SurfaceLike,
    b: SurfaceLike,
    *,
    rtol: float = DEFAULT_RTOL,
    order: float = DEFAULT_ORDER,
    scaling: bool = True,
    memory: float | str | None = None,
    seed: int = 0,
    witness: str | Path | None = None,
) -> Verdict:
    """Raise an AssertionError unless two surfaces are the same, to a tolerance.

    A test passes if they are proven to be the same: an undecided comparison fails too, with a message that says so.

    Args:
        a: Surface; see `same_surface`.
        b: Reference, likewise.
        rtol: See `same_surface`.
        order: See `same_surface`.
        scaling: See `same_surface`.
        memory: See `same_surface`.
        seed: See `same_surface`.
        witness: Beginning of the paths of files to write if the surfaces differ, such as "failures/part". Meshes are
            written as failures/part-a.ply and failures/part-b.ply, with the witness function of a against b at their
            vertices: positive where a has area that b lacks. The message then names the place where it is largest.

    Returns:
        The verdict, which is "same".

    Raises:
        AssertionError: The surfaces are different, or it is undecided. The message is one line.
        InputError: An argument is no surface, or out of range.

    >>> import sobolev_batch as sb
    >>> sphere = sb.icosphere(4)
    >>> sb.assert_same_surface(sphere, sb.Sphere(), rtol=0.01).outcome
    'same'
    >>> sb.assert_same_surface((sphere.vertices, sphere.triangles[100:]), sphere)
    Traceback (most recent call last):
        ...
    AssertionError: different surfaces: relative distance 0.05... ± 0.0005 at order -4, above rtol 0.001; area -1.9 %
    """
    __tracebackhide__ = True
    surface, reference = as_surface(a), as_surface(b)
    verdict = same_surface(surface, reference, rtol=rtol, order=order, scaling=scaling, memory=memory, seed=seed)
    if verdict:
        return verdict
    message = str(verdict)
    if witness is not None:
        try:
            difference = write_difference(surface, reference, Path(witness), order, scaling=scaling)
            message += f"; {difference}"
        except (SobolevBatchError, OSError, ValueError, TypeError) as error:
            # The test must fail for its own reason.
            message += f"; no witness: {one_line(error)}"
    raise AssertionError(message)
