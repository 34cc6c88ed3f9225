"""A first study file for a folder of meshes.

Data flow: `mesh_files` lists them, `layout` and `objects` guess what each is for, `document` writes that down, and
`init` makes the file.
"""
