"""Settings of verdicts that are not given; importing them is quick."""

from __future__ import annotations

DEFAULT_RTOL, DEFAULT_ORDER = 1e-3, -4.0
