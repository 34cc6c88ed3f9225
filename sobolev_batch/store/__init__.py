"""Store: where bytes lie and who may write them, and the zarr hierarchy of a study with its fields, records and tables.

In: a location, and a plan to create the hierarchy from. Out: arrays that any xarray reads, for all objects and each.
"""
