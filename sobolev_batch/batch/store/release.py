"""Releasing a store: taking away the claim of a run that is gone."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

from sobolev_batch.batch.storage.location import Location
from sobolev_batch.batch.storage.lock import Claim, remove_claim
from sobolev_batch.batch.storage.timestamps import age_seconds
from sobolev_batch.batch.store.heartbeat import PATIENCE_SECONDS
from sobolev_batch.batch.store.store import Store
from sobolev_batch.errors import ClaimError, StoreError


def release(place: str | Path | Location, *, force: bool = False) -> Claim | None:
    """Take away the claim of a run that cannot do so itself, because it or its machine was killed.

    A run that is still going on ends when it notices, within seconds.

    Args:
        place: path or URL of the store.
        force: even if there was a sign of life of the run a moment ago.

    Returns:
        The claim, or None where there was none.

    Raises:
        ClaimError: the run was alive a moment ago.
        StoreError: the store cannot be reached or written.
    """
    location = Location.of(place)
    claim = Claim.read(location)
    if claim is None:
        return None
    if not force and claim.is_of_the_living:
        raise ClaimError(f"{location}: {claim.driver} is alive; stop it, or release the store all the same by --force")
    silence = math.inf if force or claim.is_of_the_dead else _silence_seconds(location, claim)
    if silence < PATIENCE_SECONDS:
        raise ClaimError(
            f"{location}: {claim.driver} was alive {max(silence, 0):.0f} s ago; stop it, or wait until it has been "
            f"silent for {PATIENCE_SECONDS:.0f} s; --force releases the store all the same"
        )
    remove_claim(location)
    return claim


def _silence_seconds(location: Location, claim: Claim) -> float:
    """Since the latest sign of life of a claim's holder."""
    signs = [claim.since]
    # Of a store that cannot be read, the claim itself is all that is known.
    with suppress(StoreError):
        store = Store(location)
        run = store.read_run() if store.is_there() else None
        if run is not None and run.driver.startswith(claim.driver):
            signs.append(run.seen)
    ages = []
    for moment in signs:
        with suppress(ValueError):  # not a time that this program writes
            ages.append(age_seconds(moment))
    return min(ages, default=math.inf)
