"""Timestamps of records and locks: UTC, in ISO 8601, to the second."""

from __future__ import annotations

import calendar
import time

_FORMAT = "%Y-%m-%dT%H:%M:%SZ"


def utc_now() -> str:
    """Return the time in UTC.

    >>> len(utc_now())
    20
    """
    return time.strftime(_FORMAT, time.gmtime())


def age_seconds(moment: str) -> float:
    """Return the seconds since a time that `utc_now` returned."""
    return time.time() - calendar.timegm(time.strptime(moment, _FORMAT))
