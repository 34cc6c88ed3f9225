"""The coarsest mesh of a family that is within a tolerance: what to try next, and how a mesh is judged."""
