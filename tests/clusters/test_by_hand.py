"""Several machines by hand: certificates, scheduler, workers and a study, by the documented commands."""

from __future__ import annotations

import re
import shutil
import socket
import ssl
import stat
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import dask
import pytest
import yaml
from distributed import Client

from sobolev_batch import ClusterError, open_store
from sobolev_batch.batch.cluster.clients import check_connection, remote_client
from tests.support.commands import COMMAND, finished
from tests.support.processes import PATIENCE_SECONDS, listening, scheduler_address, stop
from tests.support.recipes import CERTIFICATES, TABLE, documented, environment, run_recipe, write_study
from tests.support.stores import contents

pytestmark = pytest.mark.all


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def certificates(home: Path) -> Path:
    made = finished(CERTIFICATES, home / "dask-tls")
    assert made.returncode == 0, made.stderr
    assert f"export DASK_CONFIG={home}/dask-tls/tls.yaml" in made.stdout
    return home / "dask-tls"


@pytest.fixture(scope="module")
def others(home: Path) -> Path:
    assert finished(CERTIFICATES, home / "others", "2").returncode == 0
    return home / "others"


def configured(folder: Path | None) -> Any:
    """Set Dask's configuration as if DASK_CONFIG named the tls.yaml of a folder."""
    settings = yaml.safe_load((folder / "tls.yaml").read_text()) if folder else {}
    return dask.config.set(dask.config.merge(dask.config.config, settings))


class Cluster(NamedTuple):
    address: str
    processes: list[subprocess.Popen[str]]


@pytest.fixture(scope="module")
def cluster(home: Path, certificates: Path) -> Iterator[Cluster]:
    """Yield a scheduler and two workers, started as documented but on loopback and free ports."""
    ((_, export),) = documented("export DASK_CONFIG=~/dask-tls")
    variable, value = export.replace("~", str(home)).split("=")
    (scheduler,), (worker, *_) = documented("dask scheduler"), documented("dask worker")
    changes = {"8786": "0", "127.0.0.1:8787": "127.0.0.1:0", "--interface": "--host", "eth0": "127.0.0.1", "-1": "2"}

    def start(words: list[str], stderr: Any) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", words[0], *(changes.get(word, word) for word in words[1:])]
        process = subprocess.Popen(command, env=environment(home, **{variable: value}), stderr=stderr, text=True)
        stack.callback(stop, process)
        return process

    with ExitStack() as stack:
        log = stack.enter_context((home / "worker.log").open("w"))
        first = start(scheduler, subprocess.PIPE)
        changes["tls://HOST:8786"] = address = scheduler_address(first)
        second = start(worker, log)
        with configured(certificates), Client(address) as client:
            client.wait_for_workers(2, timeout=PATIENCE_SECONDS)
        yield Cluster(address, [first, second])


def test_certificates_are_for_their_owner_and_stay(certificates: Path, home: Path) -> None:
    files = sorted(certificates.iterdir())
    assert [file.name for file in files] == ["ca.pem", "certificate.pem", "key.pem", "tls.yaml"]
    assert stat.S_IMODE(certificates.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    assert finished("openssl", "verify", "-x509_strict", "-CAfile", *files[:2]).returncode == 0
    before = contents(certificates)
    again = finished(CERTIFICATES, certificates)
    assert again.returncode == 2
    assert f"{certificates} already exists" in again.stderr
    assert contents(certificates) == before
    assert not list(home.glob(".make-certificates*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "call it as: make-certificates FOLDER"),
        (["new", "soon"], "DAYS is soon"),
        (["nowhere/new"], "the folder nowhere for new does not exist"),
        (['n"ew'], 'contains one of " '),
    ],
)
def test_certificates_are_not_made(arguments: list[str], message: str, tmp_path: Path) -> None:
    completed = finished(CERTIFICATES, *arguments, cwd=tmp_path)
    assert completed.returncode == 2
    assert message in completed.stderr
    assert not list(tmp_path.iterdir())


def test_a_study_over_tls(cluster: Cluster, certificates: Path, home: Path, tmp_path: Path) -> None:
    write_study(tmp_path)
    (run,) = documented("sobolev-batch run")
    words = [cluster.address if word == "tls://HOST:8786" else word for word in run[1:]]
    variables = {"HOME": str(home), "DASK_CONFIG": str(certificates / "tls.yaml")}
    completed = run_recipe(tmp_path, *COMMAND, *words, **variables)
    assert completed.returncode == 0, completed.stderr
    assert re.search(TABLE, completed.stdout)
    meshes = open_store(tmp_path / "storage" / "small.zarr")["meshes"].to_dataset()
    assert all(worker.startswith("tls://") for worker in meshes["worker"].values.tolist())
    # Nothing listens beyond loopback.
    assert {ip for ip, _ in listening(*(process.pid for process in cluster.processes))} == {"127.0.0.1"}


def test_a_client_without_certificate_is_refused(cluster: Cluster, certificates: Path) -> None:
    context = ssl.create_default_context(cafile=certificates / "ca.pem")
    context.check_hostname = False
    host, port = cluster.address.removeprefix("tls://").split(":")
    with (
        socket.create_connection((host, int(port)), timeout=PATIENCE_SECONDS) as plain,
        context.wrap_socket(plain) as encrypted,
        pytest.raises(ssl.SSLError, match="certificate required"),
    ):
        encrypted.recv(1)


def test_each_way_to_miss_an_encrypted_scheduler_is_told_in_one_line(
    cluster: Cluster, certificates: Path, others: Path, tmp_path: Path
) -> None:
    def refusal(folder: Path | None, address: str) -> str:
        with configured(folder), pytest.raises(ClusterError) as caught, remote_client(address):
            pass
        assert "\n" not in str(caught.value)
        return str(caught.value)

    plain = cluster.address.replace("tls", "tcp")
    # The right authority, and a certificate that it did not sign.
    shutil.copytree(others, tmp_path, dirs_exist_ok=True)
    shutil.copy(certificates / "ca.pem", tmp_path)
    (tmp_path / "tls.yaml").write_text((others / "tls.yaml").read_text().replace(str(others), str(tmp_path)))
    for folder, address, reason in [
        (None, cluster.address, "TLS expects a `ssl_context`"),
        (None, plain, "closed"),
        (certificates, plain, "encryption required"),
        (others, cluster.address, "certificate verify failed"),
        (tmp_path, cluster.address, "no Dask scheduler answers"),
    ]:
        message = refusal(folder, address)
        assert reason.lower() in message.lower()
        assert f"no Dask scheduler answers at {address!r}" in message
        assert "its DASK_CONFIG is needed here" in message
    (tmp_path / "key.pem").unlink()
    assert "No such file" in refusal(tmp_path, cluster.address)


@pytest.mark.parametrize(
    ("scheme", "says", "message"),
    [
        ("tcp", b"", "within 0.5 s"),
        ("tls", b"", "within 0.5 s"),
        ("tcp", b"SSH-2.0-OpenSSH_9.2\r\n", "no Dask scheduler answers"),
        ("tls", b"SSH-2.0-OpenSSH_9.2\r\n", "WRONG_VERSION_NUMBER"),
    ],
)
def test_what_listens_and_is_no_scheduler(certificates: Path, scheme: str, says: bytes, message: str) -> None:
    """Dask's own client waits for ever in the first case and runs out of memory in the third."""

    def answer() -> socket.socket:
        connection, _ = server.accept()
        connection.recv(1)
        connection.sendall(says)
        return connection

    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:
        answered = pool.submit(answer)
        address = f"{scheme}://127.0.0.1:{server.getsockname()[1]}"
        with configured(certificates if scheme == "tls" else None), pytest.raises(ClusterError, match=message):
            check_connection(address, 0.5)
        answered.result().close()
