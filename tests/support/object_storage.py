"""Object storage in threads of this process, which speaks S3 and fails as real ones do."""

from __future__ import annotations

import logging
import os
import random
import socket
import struct
import threading
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Literal, NamedTuple, NoReturn

import fsspec
import pytest

from sobolev_batch.store.location import _remote_store

SECRET, TOKEN = "a-secret-that-nobody-may-see", "a-token-that-nobody-may-see"
BUCKET = "studies"

Kind = Literal["kept", "truncated", "error", "slow down", "reset before", "reset after"]
# Kinds that few requests can meet come first and are drawn first. After "reset after", the request was carried out
# without its sender knowing.
KINDS: tuple[Kind, ...] = ("kept", "truncated", "error", "slow down", "reset before", "reset after")

_ANSWERS: dict[str, tuple[str, bytes]] = {
    "error": ("500 -", b"<Error><Code>InternalError</Code><Message>InternalError by a test</Message></Error>"),
    "slow down": ("503 -", b"<Error><Code>SlowDown</Code><Message>SlowDown by a test</Message></Error>"),
    "kept": ("200 -", b"<DeleteResult><Error><Key>one</Key><Code>InternalError</Code></Error></DeleteResult>"),
}


@dataclass(frozen=True)
class Rule:
    """The probability that a request fails, if it has the method, and a part in its path and query.

    The rarest kinds come first. Only answers to GET can be truncated, and only keys that are to be removed can be kept,
    in an otherwise good answer. After `most` failures nothing fails any more.
    """

    rate: float
    kinds: tuple[Kind, ...] = KINDS
    method: str = ""
    most: int | None = None
    part: str = ""


HEALTHY = Rule(0.0)
GONE = Rule(1.0, ("error",))


class Request(NamedTuple):
    method: str
    path: str
    failure: Kind | None


class Server:
    """A server whose requests fail by a rule that may change at any time; healthy at first."""

    def __init__(self, seed: int = 0) -> None:
        # Imported late, as below: they take a second each.
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
        from werkzeug.serving import make_server

        # Requests are recorded here.
        logging.getLogger("werkzeug").setLevel(logging.ERROR)

        self._moto = DomainDispatcherApplication(create_backend_app)
        self._random = random.Random(seed)
        self._rule = HEALTHY
        self._turn: list[tuple[str, str, Rule]] = []
        self._failed: Counter[Kind] = Counter()
        self._requests: list[Request] = []
        self._lock, self._conditional = threading.Lock(), threading.Lock()
        self.http = make_server("127.0.0.1", 0, self._answer, threaded=True, request_handler=MotoRequestHandler)
        self.url = f"http://127.0.0.1:{self.http.server_port}"
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        self.client().create_bucket(Bucket=BUCKET)

    def obey(self, rule: Rule) -> None:
        with self._lock:
            self._rule, self._failed = rule, Counter()

    def await_turn(self, method: str, part: str, number: int, rule: Rule) -> None:
        """Replace the rule at the given number of requests to come with a method and a text in their path."""
        with self._lock:
            self._turn = [(method, part, rule)] * number

    def requests(self) -> tuple[Request, ...]:
        with self._lock:
            return tuple(self._requests)

    def failures(self) -> Counter[Kind]:
        return Counter(request.failure for request in self.requests() if request.failure)

    def environment(self, key: str = "tester", secret: str = SECRET) -> dict[str, str]:
        """Return the environment of a process that uses the server."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": key,
            "AWS_SECRET_ACCESS_KEY": secret,
            "AWS_DEFAULT_REGION": "us-east-1",
            # Only these variables count, whatever credentials this machine has.
            "AWS_CONFIG_FILE": "/nonexistent",
            "AWS_SHARED_CREDENTIALS_FILE": "/nonexistent",
            "AWS_EC2_METADATA_DISABLED": "true",
        }

    def client(self, service: str = "s3") -> Any:
        """Return a client of the server that shares nothing with the code under test."""
        import boto3

        keys = {"aws_access_key_id": "tester", "aws_secret_access_key": SECRET}
        return boto3.client(service, endpoint_url=self.url, region_name="us-east-1", **keys)

    def keys(self, prefix: str) -> list[str]:
        pages = self.client().get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix)
        return [entry["Key"] for page in pages for entry in page.get("Contents", ())]

    def enforce(self, enforced: bool) -> None:
        """Let the server check signatures and policies from now on, or no longer."""
        data = b"0" if enforced else b"inf"
        # As a form, the default, the number would be read as a name.
        request = urllib.request.Request(f"{self.url}/moto-api/reset-auth", data, {"Content-Type": "text/plain"})
        urllib.request.urlopen(request).close()

    def _answer(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        body = environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        kind = self._draw(environ["REQUEST_METHOD"], environ["REQUEST_URI"])
        if kind == "reset before":
            _reset(environ)
        if kind in _ANSWERS:
            status, document = _ANSWERS[kind]
            start_response(status, [("Content-Type", "application/xml"), ("Content-Length", str(len(document)))])
            return [document]
        # Moto looks for the key and writes it in two steps, and two writers at once might both find nothing there.
        with self._conditional if "HTTP_IF_NONE_MATCH" in environ else nullcontext():
            head: list[Any] = []
            answer = b"".join(
                self._moto({**environ, "wsgi.input": BytesIO(body)}, lambda *arguments: head.extend(arguments))
            )
        if kind == "reset after":
            _reset(environ)
        start_response(*head)
        return [answer[: len(answer) // 2] if kind == "truncated" else answer]

    def _draw(self, method: str, path: str) -> Kind | None:
        with self._lock:
            if self._turn and self._turn[0][0] == method and self._turn[0][1] in path:
                *_, rule = self._turn.pop()
                if not self._turn:
                    self._rule, self._failed = rule, Counter()
            kind = self._drawn(method, path)
            self._requests.append(Request(method, path, kind))
            return kind

    def _drawn(self, method: str, path: str) -> Kind | None:
        rule = self._rule
        possible = {"truncated": method == "GET", "kept": method == "POST" and path.endswith("?delete")}
        kinds = [kind for kind in rule.kinds if possible.get(kind, True)]
        concerned = rule.method in ("", method) and rule.part in path
        if not kinds or not concerned or self._failed.total() == rule.most or self._random.random() >= rule.rate:
            return None
        kind = min(kinds, key=self._failed.__getitem__)
        self._failed[kind] += 1
        return kind


def _reset(environ: Mapping[str, Any]) -> NoReturn:
    """Reset the connection of a request without an answer, and leave the application."""
    connection = environ["werkzeug.socket"]
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    os.close(connection.detach())
    raise ConnectionResetError


def forget_drivers() -> None:
    """Make the drivers read their environment again."""
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    _remote_store.cache_clear()


@contextmanager
def taken_for_s3(environment: Mapping[str, str]) -> Iterator[None]:
    """Make this process, and all that it starts meanwhile, use a server as S3; here without a pause before retries."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        patch.setattr("botocore.retryhandler.delay_exponential", lambda base, growth_factor, attempts: 0.0)
        forget_drivers()
        yield
        forget_drivers()


@contextmanager
def serving(seed: int = 0) -> Iterator[Server]:
    server = Server(seed)
    try:
        yield server
    finally:
        server.http.shutdown()
        server.http.server_close()
