"""What docs/reliability.md promises, with real processes that are really killed."""
