"""Addresses of schedulers: malformed ones, and networks that would have to be trusted."""

from __future__ import annotations

import pickle
import socket
from typing import Any

import pytest

from sobolev_batch import ClusterError, InputError
from sobolev_batch.batch.cluster.clients import remote_client, require_private

MALFORMED = ["", "tcp://host", "host", "http://host:80", "tcp://host:port", "tcp://:8786", "tcp://host:0"]
MALFORMED += ["tcp://host:99999", "tcp://::1:8786", "tcp://[::1:8786", "a://b://c:1"]


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed(name: str) -> None:
    with pytest.raises(InputError, match="is not the address of a scheduler"), remote_client(name, True):
        pass


@pytest.mark.parametrize(
    "name",
    [
        *("tls://example.invalid:1", "wss://192.0.2.1:1", "inproc://192.0.2.1/1/2", "tcp://127.0.0.1:1"),
        *("127.9.9.9:1", "tcp://[::1]:1", "ws://localhost:1", "tcp://[::ffff:127.0.0.1]:1"),
    ],
)
def test_private(name: str) -> None:
    require_private(name, "the scheduler")


@pytest.mark.parametrize("name", ["tcp://192.0.2.1:1", "192.0.2.1:1", "ws://[2001:db8::1]:1", "tcp://0.0.0.0:1"])
def test_open_to_others(name: str) -> None:
    with pytest.raises(InputError, match="is neither encrypted nor on loopback") as caught, remote_client(name):
        pass
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(("places", "private"), [(["127.0.0.1", "::1"], True), (["127.0.0.1", "192.0.2.1"], False)])
def test_all_that_a_name_stands_for_counts(places: list[str], private: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    def look_up(host: str, port: int, **options: Any) -> list[tuple[Any, ...]]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (place, port)) for place in places]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    if private:
        require_private("tcp://scheduler:8786", "the scheduler")
    else:
        with pytest.raises(InputError, match=r"\(192\.0\.2\.1\)"):
            require_private("tcp://scheduler:8786", "the scheduler")


def test_a_host_that_is_not_there_is_no_wrong_input() -> None:
    with pytest.raises(ClusterError, match=r"there is no host 'example\.invalid'") as caught:
        require_private("tcp://example.invalid:1", "the scheduler")
    assert not isinstance(caught.value, InputError)
