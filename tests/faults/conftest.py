"""Clusters and studies, as in the tests of the batch room."""

from tests.batch.conftest import client, finished_store, store_path, study

__all__ = ["client", "finished_store", "store_path", "study"]
