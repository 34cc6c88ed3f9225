"""Tests of sobolev_batch: their folders are those of the package."""

import os

# Three processes share two cores. Threads of BLAS and OpenMP that spin while they wait would take half of them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
