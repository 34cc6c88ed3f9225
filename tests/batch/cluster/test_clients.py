"""Addresses of schedulers, real schedulers and workers, and the ports that a local cluster opens."""

from __future__ import annotations

import os
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from distributed import Client, LocalCluster, Security

from sobolev_batch import Study, run
from sobolev_batch.batch.cluster.clients import check_connection, remote_client, require_private
from sobolev_batch.batch.cluster.execution import Progress
from sobolev_batch.errors import ClusterError, InputError
from tests.support.commands import call
from tests.support.processes import PATIENCE_SECONDS, WORKER, dask, listening, tcp_cluster
from tests.support.recipes import write_study


@pytest.mark.slow
def test_a_scheduler_without_workers() -> None:
    with (
        LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0") as cluster,
        pytest.raises(ClusterError, match="has no workers; start some with: dask worker"),
    ):
        remote_client(cluster.scheduler_address).__enter__()


@pytest.mark.process
def test_a_script_without_a_guarded_main_part_is_told_what_it_lacks(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("from sobolev_batch.batch.cluster.clients import local_client\nlocal_client(1).__enter__()\n")
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert ended.returncode == 1
    # Neither the workers nor Dask tell the same beside it.
    assert ended.stderr.count("Traceback") == 1
    assert ended.stderr.splitlines()[-1].endswith("""needs 'if __name__ == "__main__":' around its main part""")


def test_a_cluster_that_adapts_from_no_worker_at_all(study: Study) -> None:
    options = {"processes": False, "protocol": "inproc://", "threads_per_worker": 1}
    pages = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=0, **options, **pages) as cluster, Client(cluster) as client:
        # A worker that has just started does not leave again before it is set up.
        cluster.adapt(minimum=0, maximum=1, interval="20ms", wait_count=100_000)
        assert len(run(study, "memory://adapted.zarr", client).computed) == 5


def test_workers_that_leave_while_they_are_set_up_are_waited_for(
    study: Study, threads: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_on_workers, asked = threads.run, list[str]()

    def run_once_left(function: Callable[..., object], *arguments: object, **options: object) -> object:
        asked.append(function.__name__)
        # Of the worker that was there for the versions, nothing is heard any more.
        return {} if asked.count("_describe") == 1 else run_on_workers(function, *arguments, **options)

    monkeypatch.setattr(threads, "run", run_once_left)
    assert len(run(study, "memory://left.zarr", threads).computed) == 5
    assert asked.count("_describe") == 2


@pytest.mark.all
def test_a_scheduler_that_others_could_reach_is_for_those_who_say_so(tmp_path: Path) -> None:
    """0.0.0.0 leads to loopback, and is not known to: what listens here nobody else reaches."""
    write_study(tmp_path)
    with tcp_cluster([]) as (address, _):
        beyond = address.replace("127.0.0.1", "0.0.0.0")
        arguments: list[str | Path] = ["plan", tmp_path / "study.toml", "--scheduler", beyond]
        refused, trusted = call(*arguments), call(*arguments, "--trust-network")
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"error: the scheduler at {beyond} is neither encrypted nor on loopback (0.0.0.0)")
    assert trusted.returncode == 0, trusted.stderr
    assert "1, with 1 threads" in trusted.stdout


@pytest.mark.all
def test_a_worker_that_others_could_reach_counts_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    listening = ["--listen-address", f"tcp://127.0.0.1:{port}", "--contact-address", f"tcp://0.0.0.0:{port}"]
    with tcp_cluster() as (address, processes):
        processes.append(dask("worker", address, *WORKER[2:], *listening))
        with Client(address) as client:
            client.wait_for_workers(1, timeout=PATIENCE_SECONDS)
        with pytest.raises(InputError, match=rf"a worker at tcp://0\.0\.0\.0:{port} is neither"):
            remote_client(address).__enter__()
        with remote_client(address, trust_network=True) as client:
            assert client.submit(abs, -1).result() == 1


def test_whoever_lacks_the_certificates_of_a_local_cluster_is_refused(client: Client) -> None:
    workers = client.scheduler_info(n_workers=-1)["workers"]
    addresses = {client.scheduler.address, *workers, *(worker["nanny"] for worker in workers.values())}
    assert len(addresses) == 5
    without, other = ssl.create_default_context(), Security.temporary().get_connection_args("client")["ssl_context"]
    for context in (without, other):
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    for address in addresses:
        assert address.startswith("tls://127.0.0.1:")
        place = "127.0.0.1", int(address.rpartition(":")[2])
        for context in (without, other):
            with pytest.raises(ssl.SSLError), socket.create_connection(place) as bare, context.wrap_socket(bare) as own:
                own.recv(1)


@pytest.mark.parametrize(
    ("store", "least"), [pytest.param("", 4, marks=pytest.mark.all), ("memory://of-threads", 2)], ids=["run", "threads"]
)
def test_every_port_of_a_run_is_on_loopback(store: str, least: int, study: Study, store_path: Path) -> None:
    """Scheduler, its dashboard, each worker with its nanny and web pages; threads have web pages alone."""
    before, found = listening(os.getpid()), set[tuple[str, int]]()

    def look(progress: Progress) -> None:
        if progress.stage == "fields" and progress.done == 1:
            found.update(listening(os.getpid()) - before)
        elif progress.stage == "cluster":
            links.append(progress.label)

    links: list[str] = []
    run(study, store or store_path, workers=2, on_progress=look)
    assert {ip for ip, _ in found} <= {"127.0.0.1", "::1"}, found
    assert len(found) >= least, found
    assert links[0] in {f"http://{ip}:{port}/status" for ip, port in found}


MALFORMED = ["", "tcp://host", "host", "http://host:80", "tcp://host:port", "tcp://:8786", "tcp://host:0"]
MALFORMED += ["tcp://host:99999", "tcp://::1:8786", "tcp://[::1:8786", "a://b://c:1"]


PRIVATE = ["tls://example.invalid:1", "wss://192.0.2.1:1", "inproc://192.0.2.1/1/2", "tcp://127.0.0.1:1"]
PRIVATE += ["127.9.9.9:1", "tcp://[::1]:1", "ws://localhost:1", "tcp://[::ffff:127.0.0.1]:1"]


def test_private_addresses_those_that_are_open_to_others_malformed_ones_and_none() -> None:
    for name in PRIVATE:
        require_private(name, "the scheduler")
    for name in ("tcp://192.0.2.1:1", "192.0.2.1:1", "ws://[2001:db8::1]:1", "tcp://0.0.0.0:1"):
        with pytest.raises(InputError, match="is neither encrypted nor on loopback"):
            remote_client(name).__enter__()
    for name in MALFORMED:
        with pytest.raises(InputError, match="is not the address of a scheduler"):
            remote_client(name, True).__enter__()
    with pytest.raises(ClusterError, match=r"there is no host 'example\.invalid'") as caught:
        require_private("tcp://example.invalid:1", "the scheduler")
    assert not isinstance(caught.value, InputError)


def test_a_client_without_certificates_fails_at_once_and_says_so() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        pytest.raises(ClusterError, match=r"no Dask scheduler answers at 'tls://\S+' \(") as refused,
    ):
        check_connection(f"tls://127.0.0.1:{server.getsockname()[1]}", 1e6)
    assert "its DASK_CONFIG is needed here" in str(refused.value)


def test_all_that_a_name_stands_for_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    places = ["127.0.0.1", "::1"]

    def look_up(host: str, port: int, **options: Any) -> list[tuple[Any, ...]]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (place, port)) for place in places]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    require_private("tcp://scheduler:8786", "the scheduler")
    places.append("192.0.2.1")
    with pytest.raises(InputError, match=r"\(192\.0\.2\.1\)"):
        require_private("tcp://scheduler:8786", "the scheduler")
