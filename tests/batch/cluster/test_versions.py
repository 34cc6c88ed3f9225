"""Workers, schedulers and clients with other versions than the rest of their cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from distributed import Client

from sobolev_batch import ClusterError, Study, run
from sobolev_batch.batch.cluster import workers
from sobolev_batch.batch.cluster.workers import require_same_versions
from sobolev_batch.batch.store.store import Store


@pytest.mark.parametrize(
    ("process", "package", "version", "message"),
    [
        (
            "workers",
            "sobolev-batch",
            "9.9",
            r"sobolev-batch 9\.9 at the worker tcp://\S+ and 1 more, \S+ here",
        ),
        ("workers", "sobolev-batch", None, r"sobolev-batch is missing at the worker tcp://"),
        ("workers", "python", "3.9.1.final.0", r"python 3\.9 at the worker tcp://.*, 3\.\d+ here"),
        ("scheduler", "dask", "1.0", r"dask 1\.0 at the scheduler tcp://"),
    ],
)
def test_differences_are_reported_before_anything_is_computed(
    process: str, package: str, version: str | None, message: str,
    client: Client, study: Study, store_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    ask = client.get_versions

    def answer(**options: Any) -> dict[str, Any]:
        answers: dict[str, Any] = ask(**options)
        for reply in answers["workers"].values() if process == "workers" else [answers["scheduler"]]:
            reply["packages"][package] = version
        return answers

    monkeypatch.setattr(client, "get_versions", answer)
    with pytest.raises(ClusterError, match=message):
        run(study, store_path, client)
    assert Store(store_path).records() == (None,) * 5


def test_a_checkout_with_other_numerics(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "NUMERICS_VERSION", -1)
    with pytest.raises(ClusterError, match=r"numerics of sobolev-batch \d+ at the worker .*, -1 here"):
        require_same_versions(client)


def test_a_library_that_the_study_needs(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_same_versions(client, ["installed-nowhere"])  # planning reports this
    information = tmp_path / "remesher_of_a_test-2.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: remesher-of-a-test\nVersion: 2.0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    require_same_versions(client)
    with pytest.raises(ClusterError, match=r"remesher-of-a-test is missing at the worker .*, 2\.0 here"):
        require_same_versions(client, ["remesher-of-a-test"])
