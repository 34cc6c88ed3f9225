"""Loaded into a worker before it starts: gives its host one GPU, which computes on the processor.

``dask worker --preload tests/support/pretend_gpu.py``; the device's name is in the environment, so that the
workers of one test share it and those of another do not.
"""

from __future__ import annotations

import os

from sobolev_batch.batch.cluster import workers
from tests.support.fake_device import Device

_DEVICE = Device(capacity=float(os.environ.get("PRETEND_GPU_BYTES", "1e12")))
_NAME = os.environ["PRETEND_GPU"]

vars(workers)["visible_devices"] = lambda: (_NAME,)
vars(workers)["gpu_backend"] = _DEVICE.backend
