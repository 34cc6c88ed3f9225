"""A study becomes tasks: study file, plan, store, worker tasks, reduction, run."""
