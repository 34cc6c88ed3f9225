"""Storage: the keys of a store, in a folder or in object storage, and the lock on it.

In: a path or a URL. Out: keys that are read, written and listed, by one run at a time.
"""
