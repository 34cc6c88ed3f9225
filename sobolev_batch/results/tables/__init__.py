"""Tables: rows and columns that people and programs read.

In: a store that is open. Out: text, CSV, JSON, Markdown and LaTeX.
"""
