"""What the tests of this room share beside shapes and formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sobolev_batch import Mesh, read_mesh

Read = Callable[[str, bytes], Mesh]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Write a file whose name has this ending, and read it."""

    def write_and_read(ending: str, content: bytes) -> Mesh:
        path = tmp_path / f"mesh{ending}"
        path.write_bytes(content)
        return read_mesh(path)

    return write_and_read
