"""Defaults of fits, which the command line shows without importing what computes."""

DEFAULT_ORDER, DEFAULT_STEPS, DEFAULT_SMOOTHING = -2.0, 150, 0.25
