"""Stores of parts of a study that become one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from distributed import Client

import sobolev_batch as sb
from tests.support.studies import small_table


def study(levels: list[int], name: str = "ico", **changes: Any) -> sb.Study:
    family = [{"name": name, "source": "icosphere", "levels": levels}]
    return sb.Study.from_table(small_table(family=family, **changes))


@pytest.fixture
def parts(tmp_path: Path, client: Client) -> list[Path]:
    """Two stores, of which the second calls its family by another name."""
    paths = [tmp_path / "a.zarr", tmp_path / "b.zarr"]
    for path, part in zip(paths, (study([0, 1]), study([2], "other")), strict=True):
        sb.run(part, path, client)
    return paths


def test_fields_of_other_stores_are_copied_whatever_they_are_called(
    tmp_path: Path, parts: list[Path], client: Client
) -> None:
    whole, alone = tmp_path / "whole.zarr", tmp_path / "alone.zarr"
    summary = sb.run(study([0, 1, 2, 3]), whole, client, reuse=parts)
    assert summary.computed == ("ico/3",)
    sb.run(study([0, 1, 2, 3]), alone, client)
    copied, computed = (sb.open_store(store)["distances"].load() for store in (whole, alone))
    np.testing.assert_array_equal(copied["distance"], computed["distance"])
    np.testing.assert_array_equal(copied["error"], computed["error"])
    assert sb.verify(whole).is_sound


def test_a_damaged_field_is_computed_instead(tmp_path: Path, parts: list[Path], client: Client) -> None:
    chunk = parts[1] / "fourier/fourier/c/0/0/0/0"
    data = bytearray(chunk.read_bytes())
    data[100] ^= 1
    chunk.write_bytes(data)
    summary = sb.run(study([2]), tmp_path / "whole.zarr", client, reuse=parts)
    assert summary.computed == ("ico/2",)


def test_fields_for_another_lattice_are_not_taken(tmp_path: Path, parts: list[Path], client: Client) -> None:
    finer = study([0], lattice={"xi_max": 3.0, "M": 18})
    assert set(sb.run(finer, tmp_path / "finer.zarr", client, reuse=parts).computed) == {"ico/0", "reference"}


def test_another_store_that_is_none_is_refused_before_anything_is_written(
    tmp_path: Path, parts: list[Path], client: Client
) -> None:
    zarr.create_group(str(tmp_path / "empty.zarr"))
    with pytest.raises(sb.StoreError, match=r"empty\.zarr: a zarr store, but not one of a study"):
        sb.run(study([0]), tmp_path / "new.zarr", client, reuse=[tmp_path / "empty.zarr"])
    assert not (tmp_path / "new.zarr").exists()
