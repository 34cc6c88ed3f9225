"""Sources that make their surfaces from the one mesh of another source.

In: a table with the table of the other source. Out: members that load that mesh and change it.
"""
