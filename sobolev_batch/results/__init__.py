"""What people read: an opened store, tables, plots."""
