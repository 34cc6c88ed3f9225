"""Tables: stored fields become norms, distances and convergence tables, and people and programs read them.

In: a store. Out: xarray data, pandas tables, text, CSV, JSON, Markdown and LaTeX.
"""

from typing import Literal, get_args

# Formats of tables; commands list them without importing what makes tables.
Format = Literal["text", "csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)
