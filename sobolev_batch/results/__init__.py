"""Results: what people read of a store.

In: the path or URL of a store. Out: xarray data, tables, figures, mesh files and a report.
"""
