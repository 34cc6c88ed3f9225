"""Object storage that fails as a real one does: a proxy in this process, before a server that speaks S3.

Requests are passed on unchanged. Signatures cover the host name that the client uses; the server gets it too, so
they stay valid.
"""

from __future__ import annotations

import random
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Literal
from urllib.parse import urlsplit

from tests.support.object_storage import Server

Kind = Literal["kept", "truncated", "error", "slow down", "reset before", "reset after"]
# Kinds that few requests can meet come first and are drawn first. After "reset after", the request was carried out
# without its sender knowing.
KINDS: tuple[Kind, ...] = ("kept", "truncated", "error", "slow down", "reset before", "reset after")

_ANSWERS: dict[str, tuple[int, str]] = {
    "error": (500, "<Error><Code>InternalError</Code><Message>InternalError by a test</Message></Error>"),
    "slow down": (503, "<Error><Code>SlowDown</Code><Message>SlowDown by a test</Message></Error>"),
    "kept": (200, "<DeleteResult><Error><Key>one</Key><Code>InternalError</Code></Error></DeleteResult>"),
}
_OF_ONE_HOP = ("connection", "expect", "keep-alive", "transfer-encoding")


@dataclass(frozen=True)
class Rule:
    """Rule by which requests fail.

    Attributes:
        rate: Probability of a failure.
        kinds: Kinds of failures, the rarest first. Only answers to GET can be truncated, and only keys that are to be
            removed can be kept, in an otherwise good answer.
        methods: Methods that may fail; all if empty.
        most: Number of failures after which nothing fails any more.
        part: Text in the path and query of requests that may fail.
    """

    rate: float
    kinds: tuple[Kind, ...] = KINDS
    methods: frozenset[str] = frozenset()
    most: int | None = None
    part: str = ""


HEALTHY = Rule(0.0)
GONE = Rule(1.0, ("error",))
READ_ONLY = Rule(1.0, ("error",), frozenset({"PUT", "POST", "DELETE"}))


@dataclass(frozen=True)
class Turn:
    """Change of the rule, at the given number of requests with a method and a text in their path."""

    method: str
    part: str
    number: int
    rule: Rule


@dataclass(frozen=True)
class Request:
    """A request, its time, and its failure, if any."""

    method: str
    path: str
    seconds: float
    failure: Kind | None


@dataclass
class FailingStorage:
    """A server of object storage whose requests fail by a rule that may change at any time.

    Attributes:
        url: Endpoint of the proxy.
    """

    url: str
    _server: Server
    _random: random.Random
    _rule: Rule = HEALTHY
    _turn: Turn | None = None
    _listener: Callable[[], None] = lambda: None
    _failed: Counter[Kind] = field(default_factory=Counter)
    _requests: list[Request] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def rule(self) -> Rule:
        """Rule by which requests fail from now on."""
        return self._rule

    @rule.setter
    def rule(self, rule: Rule) -> None:
        with self._lock:
            self._rule, self._failed = rule, Counter()

    def await_turn(self, turn: Turn) -> None:
        """Replace the rule at a request to come."""
        with self._lock:
            self._turn = turn

    def call(self, listener: Callable[[], None]) -> None:
        """Call a function at each request, before it is handled."""
        self._listener = listener

    def environment(self) -> dict[str, str]:
        """Return the environment of a process that uses it."""
        return {**self._server.environment(), "AWS_ENDPOINT_URL": self.url}

    def requests(self) -> tuple[Request, ...]:
        """Return all requests so far, in order."""
        with self._lock:
            return tuple(self._requests)

    def failures(self) -> Counter[Kind]:
        """Return the number of failures so far, by kind."""
        return Counter(request.failure for request in self.requests() if request.failure)

    def draw(self, method: str, path: str) -> Kind | None:
        """Return the kind of failure of a new request, if it is to fail."""
        self._listener()
        with self._lock:
            turn = self._turn
            if turn and turn.method == method and turn.part in path:
                self._turn = replace(turn, number=turn.number - 1) if turn.number > 1 else None
                if self._turn is None:
                    self._rule, self._failed = turn.rule, Counter()
            kind = self._drawn(method, path)
            self._requests.append(Request(method, path, time.monotonic(), kind))
            return kind

    def upstream(self) -> HTTPConnection:
        """Return a connection to the server itself."""
        return HTTPConnection(urlsplit(self._server.url).netloc)

    def _drawn(self, method: str, path: str) -> Kind | None:
        rule = self._rule
        possible = {"truncated": method == "GET", "kept": method == "POST" and path.endswith("?delete")}
        kinds = [kind for kind in rule.kinds if possible.get(kind, True)]
        concerned = (not rule.methods or method in rule.methods) and rule.part in path
        if not kinds or not concerned or self._failed.total() == rule.most or self._random.random() >= rule.rate:
            return None
        kind = min(kinds, key=self._failed.__getitem__)
        self._failed[kind] += 1
        return kind


@contextmanager
def failing(server: Server, seed: int = 0) -> Iterator[FailingStorage]:
    """Run a proxy before a server, healthy at first."""
    with _Proxy(("127.0.0.1", 0), _Handler) as proxy:
        proxy.storage = FailingStorage(f"http://127.0.0.1:{proxy.server_port}", server, random.Random(seed))
        thread = threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield proxy.storage
        finally:
            proxy.shutdown()
            thread.join()


class _Proxy(ThreadingHTTPServer):
    storage: FailingStorage
    # Clients keep their connections.
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def handle_error(self, request: object, client_address: object) -> None:
        """Do nothing: a client that is killed leaves its connection behind."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    # Headers and body are written by themselves, and the second would wait for the first to be acknowledged.
    disable_nagle_algorithm = True
    server: _Proxy

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - as the base class has it
        """Do nothing: requests are recorded."""

    def _pass_on(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        kind = self.server.storage.draw(self.command, self.path)
        if kind == "reset before":
            self._reset()
        elif kind in _ANSWERS:
            status, document = _ANSWERS[kind]
            self._answer(status, [("Content-Type", "application/xml")], document.encode())
        else:
            status, headers, answer = self._ask(body)
            if kind == "reset after":
                self._reset()
            elif kind == "truncated" and answer:
                self._answer(status, headers, answer, len(answer) // 2)
                self._reset()
            else:
                self._answer(status, headers, answer)

    do_DELETE = do_GET = do_HEAD = do_POST = do_PUT = _pass_on  # noqa: N815

    def _ask(self, body: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
        upstream = self.server.storage.upstream()
        try:
            upstream.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
            for name, value in self.headers.items():
                if name.lower() not in _OF_ONE_HOP:
                    upstream.putheader(name, value)
            upstream.endheaders(body)
            answer = upstream.getresponse()
            headers = [(name, value) for name, value in answer.getheaders() if name.lower() not in _OF_ONE_HOP]
            return answer.status, headers, answer.read()
        finally:
            upstream.close()

    def _answer(self, status: int, headers: list[tuple[str, str]], body: bytes, sent: int | None = None) -> None:
        self.send_response_only(status)
        for name, value in headers:
            if self.command == "HEAD" or name.lower() != "content-length":
                self.send_header(name, value)
        if self.command != "HEAD":
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body[:sent])

    def _reset(self) -> None:
        """Reset the connection."""
        self.close_connection = True
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        # The base class would flush and say goodbye first.
        self.connection.close()
        self.rfile.close()
