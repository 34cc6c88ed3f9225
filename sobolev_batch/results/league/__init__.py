"""Methods compared over several objects, and studies with earlier ones.

See docs/leagues.md.
"""
