"""Plug-in of pytest: a fixture that asserts that two surfaces are the same, and writes files where they are not.

pytest loads it in every session of an environment, so it imports nothing else before a test requests the fixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from hashlib import sha256
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from sobolev_batch.surfaces.formats.readers import SurfaceLike
    from sobolev_batch.testing.verdict import Verdict

_OPTION, _INI = "--sobolev-witness-folder", "sobolev_witness_folder"
_HELP = (
    "Folder for PLY files of the surfaces that assert_same_surface finds different; relative to the root of the tests. "
    "By default in the cache of pytest, or in the test's temporary folder if there is no cache."
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option and the setting for the folder of witness files."""
    parser.getgroup("sobolev-batch").addoption(_OPTION, metavar="FOLDER", default=None, help=_HELP)
    parser.addini(_INI, _HELP, default="")


class SurfaceAssertion:
    """`sobolev_batch.assert_same_surface` for one test, which knows where to write witness files."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request
        self._paths = self._numbered_paths()

    def __call__(self, a: SurfaceLike, b: SurfaceLike, **settings: Any) -> Verdict:
        """Raise an AssertionError unless two surfaces are the same; see `sobolev_batch.assert_same_surface`."""
        __tracebackhide__ = True
        from sobolev_batch.testing.verdict import assert_same_surface

        return assert_same_surface(a, b, **{"witness": next(self._paths), **settings})

    def _numbered_paths(self) -> Iterator[Path]:
        """Yield the beginnings of the paths of this test's files, one for each comparison."""
        from sobolev_batch.surfaces.sources.names import file_stem

        node = self._request.node
        # Parameters may be long, or differ in characters that names of files cannot have.
        digest = sha256(node.nodeid.encode()).hexdigest()[:8]
        for number in count(1):
            stem = file_stem(number, node.name).partition("-")[2] or "test"
            yield self._folder / f"{stem}-{digest}-{number}"

    @property
    def _folder(self) -> Path:
        config = self._request.config
        chosen = config.getoption(_OPTION) or config.getini(_INI)
        if chosen:
            return config.rootpath / str(chosen)
        # Without its plug-in, pytest has no cache; and a project may lie where nothing can be written.
        cache: pytest.Cache | None = getattr(config, "cache", None)
        if cache is not None:
            with suppress(OSError):
                return cache.mkdir("sobolev-witness")
        temporary: Path = self._request.getfixturevalue("tmp_path")
        return temporary


@pytest.fixture
def assert_same_surface(request: pytest.FixtureRequest) -> SurfaceAssertion:
    """Assert that two surfaces are the same; if not, write where they differ, and name the files in the message."""
    return SurfaceAssertion(request)
