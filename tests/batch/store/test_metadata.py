"""Stores that somebody else has made, and what their metadata could have zarr and xarray do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sobolev_batch import StoreError, Study, open_store, run
from sobolev_batch.batch.store import metadata as documents
from sobolev_batch.batch.store.store import Store
from sobolev_batch.results.status import Status
from tests.support.studies import small_table

Document = dict[str, Any]


def change(store: Path, node: str, how: Callable[[Document], None]) -> None:
    """Change what the root of a store says of a node,."""
    root = json.loads((store / "zarr.json").read_text())
    how(root["consolidated_metadata"]["metadata"][node] if node else root)
    (store / "zarr.json").write_text(json.dumps(root))


def refusals(store: Path) -> set[str]:
    """What each way to read a store is told."""
    said = set()
    for read in (open_store, Status.from_store, Store.open):
        with pytest.raises(StoreError) as caught:
            read(store)
        said.add(str(caught.value))
    return said


NOT_WRITTEN_HERE: dict[str, tuple[str, Document, str]] = {
    "codec": (
        "records/record",
        {"codecs": [{"name": "numcodecs.pickle"}]},
        "the codec of records/record is 'numcodecs",
    ),
    "filter": ("fourier/mesh", {"codecs": [{"name": "vlen-utf8"}, "zstd"]}, "the codec of fourier/mesh is 'zstd'"),
    "no codec": ("fourier/mesh", {"codecs": []}, "the codec of fourier/mesh is None"),
    "type": ("meshes/name", {"data_type": "variable_length_bytes"}, "the data type of meshes/name is 'variable"),
    "objects": ("meshes/name", {"data_type": {"name": "object"}}, "the data type of meshes/name is {'name': 'object'}"),
    "transformers": ("fourier/xi_x", {"storage_transformers": [{"name": "x"}]}, "has the storage transformers"),
    "grid": ("fourier/xi_x", {"chunk_grid": {"name": "x"}}, "the chunk_grid of fourier/xi_x is {'name': 'x'}"),
    "keys": ("fourier/xi_x", {"chunk_key_encoding": {"name": "v2"}}, "the chunk_key_encoding of fourier/xi_x"),
    "version 2": ("fourier/xi_x", {"zarr_format": 2, "filters": [{"id": "pickle"}]}, "of zarr format 2"),
    "kind": ("fourier/xi_x", {"node_type": "group"}, "fourier/xi_x is 'group' of zarr format 3"),
    "unknown": ("norms", {"must_understand": True}, "norms has metadata 'must_understand'"),
    "huge": ("fourier/mesh", {"shape": [10**15]}, r"fourier/mesh has the shape [1000000000000000]"),
    "huge table": ("convergence/relative", {"shape": [10**8, 10**7]}, "convergence/relative has the shape [100000000"),
    "negative": ("fourier/mesh", {"shape": [-1]}, "fourier/mesh has the shape [-1]"),
    "repeated": (
        "norms",
        {"consolidated_metadata": {"kind": "inline", "metadata": {"b": {"node_type": "array", "zarr_format": 3}}}},
        "the data type of norms/b is None",
    ),
    "not inline": ("", {"consolidated_metadata": {"kind": "x"}}, "the consolidated metadata of the root are {'kind'"),
    "attributes": ("norms", {"attributes": []}, "the attributes of norms are no table"),
}


@pytest.mark.parametrize("case", NOT_WRITTEN_HERE)
def test_metadata_that_this_package_does_not_write(copy: Path, case: str) -> None:
    node, changes, message = NOT_WRITTEN_HERE[case]
    change(copy, node, lambda document: document.update(changes))
    (said,) = refusals(copy)
    assert said.startswith(f"{copy}: the store is not used: ")
    assert message in said
    with pytest.raises(StoreError, match="is not used"):
        run(Study.from_table(small_table()), copy)


@pytest.mark.parametrize("name", ["..", "../other", "/etc", "a/../../b", "C:\\x", "a\x00b", "fourier//c", ""])
def test_nodes_with_other_names(copy: Path, name: str) -> None:
    def add(root: Document) -> None:
        root["consolidated_metadata"]["metadata"][name] = {"node_type": "group", "zarr_format": 3, "codecs": 1}

    change(copy, "", add)
    (said,) = refusals(copy)
    assert "a node is named" in said or "has metadata 'codecs'" in said


def test_documents_beside_the_root_are_checked_when_they_are_read(copy: Path) -> None:
    path = copy / "records" / "zarr.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "node_type": "array"}))
    with pytest.raises(StoreError, match="records is 'array' of zarr format 3"):
        Status.from_store(copy)


def test_a_document_without_end(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (copy / "zarr.json").open("r+b") as file:
        file.truncate(documents.MOST_BYTES + 1)
    (said,) = refusals(copy)
    assert "zarr.json has more than" in said
    (copy / "zarr.json").write_text("[" * 100_000)
    (said,) = refusals(copy)
    assert "is damaged" in said


EVIL = """
import os
from zarr.abc.codec import ArrayBytesCodec
open(os.environ["MARKER"], "w").close()
class Evil(ArrayBytesCodec):
    pass
"""


def test_code_that_a_codec_names_is_not_imported(copy: Path, tmp_path: Path) -> None:
    """An installed distribution offers a codec: zarr imports it for whatever store has its name."""
    information = tmp_path / "site" / "evil-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[zarr.codecs]\nevil = evil:Evil\n")
    (tmp_path / "site" / "evil.py").write_text(EVIL)
    change(copy, "records/record", lambda document: document.update(codecs=[{"name": "evil"}]))
    paths = os.pathsep.join([str(tmp_path / "site"), str(Path(__file__).parents[3])])
    environment = {**os.environ, "PYTHONPATH": paths, "MARKER": str(tmp_path / "imported")}

    def call(*arguments: str) -> int:
        command = [sys.executable, *arguments]
        return subprocess.run(command, env=environment, capture_output=True, timeout=60, check=False).returncode

    assert call("-m", "sobolev_batch", "status", str(copy)) == 2
    assert call("-m", "sobolev_batch", "table", str(copy)) == 2
    assert not (tmp_path / "imported").exists()
    call("-c", f"import zarr; zarr.open({str(copy)!r})['records/record']")
    assert (tmp_path / "imported").exists()
