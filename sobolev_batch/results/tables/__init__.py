"""Tables: rows and columns that people and programs read.

In: a store that is open. Out: text, CSV, JSON, Markdown and LaTeX.
"""

from typing import Literal, get_args

# Formats of tables; commands list them without importing what makes tables.
Format = Literal["text", "csv", "json", "markdown", "latex"]
FORMATS: tuple[Format, ...] = get_args(Format)
