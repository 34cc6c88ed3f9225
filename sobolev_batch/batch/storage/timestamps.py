"""Timestamps of records and locks: UTC, in ISO 8601, to the second."""

from __future__ import annotations

import calendar
import time

_FORMAT = "%Y-%m-%dT%H:%M:%SZ"


def utc_now() -> str:
    """The time, in UTC."""
    return time.strftime(_FORMAT, time.gmtime())


def age_seconds(moment: str) -> float:
    """The time since a moment that `utc_now` has told, in seconds."""
    return time.time() - calendar.timegm(time.strptime(moment, _FORMAT))
