"""Plug-in of pytest: a fixture that asserts that two surfaces are the same, and writes files where they are not.

A conftest.py loads it by ``pytest_plugins = ["sobolev_batch.testing.pytest_plugin"]``. It imports nothing else before a
test requests the fixture.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from sobolev_batch.geometry.formats.conversion import SurfaceLike
    from sobolev_batch.testing.verdict import Verdict

_OPTION = "--sobolev-witness-folder"
_HELP = (
    "Folder for PLY files of the surfaces that assert_same_surface finds different; relative to the root of the tests. "
    "By default the temporary folder of the test."
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the folder of witness files."""
    parser.getgroup("sobolev-batch").addoption(_OPTION, metavar="FOLDER", default=None, help=_HELP)


@pytest.fixture
def assert_same_surface(request: pytest.FixtureRequest) -> Callable[..., Verdict]:
    """Assert that two surfaces are the same; if not, write where they differ, and name the files in the message."""
    numbers = count(1)

    def check(a: SurfaceLike, b: SurfaceLike, **settings: Any) -> Verdict:
        """Raise an AssertionError unless two surfaces are the same; see `sobolev_batch.testing.assert_same_surface`."""
        __tracebackhide__ = True
        from sobolev_batch.testing.verdict import assert_same_surface

        return assert_same_surface(a, b, **{"witness": _path(request, next(numbers)), **settings})

    return check


def _path(request: pytest.FixtureRequest, number: int) -> Path:
    """Return the beginning of the paths of the files of a comparison of this test."""
    from sobolev_batch.sources.names import file_stem

    # Parameters may be long, or differ in characters that names of files cannot have.
    digest = sha256(request.node.nodeid.encode()).hexdigest()[:8]
    stem = file_stem(number, request.node.name).partition("-")[2] or "test"
    chosen = request.config.getoption(_OPTION)
    folder = request.config.rootpath / str(chosen) if chosen else Path(request.getfixturevalue("tmp_path"))
    return folder / f"{stem}-{digest}-{number}"
