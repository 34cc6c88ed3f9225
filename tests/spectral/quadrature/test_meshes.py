"""Methods of quadrature on meshes."""

from __future__ import annotations

import pytest

from sobolev_batch import InputError
from sobolev_batch.spectral.quadrature.meshes import Quadrature


@pytest.mark.parametrize("method", ["gauss9", 0, 51, True, 2.5, None])
def test_refuses_other_methods(method: object) -> None:
    with pytest.raises(InputError, match="quadrature must be"):
        Quadrature(method)  # type: ignore[arg-type]
