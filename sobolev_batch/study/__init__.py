"""Study: a validated study file, and the plan that follows from it.

In: TOML or a table. Out: a frozen `Study` of objects, for each its lattice, and a `Plan` with a row per surface.
"""
