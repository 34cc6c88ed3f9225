"""Choices of the tables, which the command line shows without importing what makes them."""

from typing import Literal, get_args

Format = Literal["text", "csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)

# A mesh that is so many times as far away as at its first time is worth a new one.
REMESHING_FACTOR = 2.0
