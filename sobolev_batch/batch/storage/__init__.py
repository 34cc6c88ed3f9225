"""Storage: where the bytes of a store lie, how they are reached, and who may write them.

In: a path or a URL. Out: keys read, written and listed, in a folder or in object storage.
"""
