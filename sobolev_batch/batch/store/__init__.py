"""Store: the zarr hierarchy of a study, with its fields, records and tables.

In: a plan to create it from, fields and records to write. Out: arrays that any xarray reads.
"""
