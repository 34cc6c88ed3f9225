"""A local server that speaks the S3 protocol, in a process of its own."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import fsspec
import pytest

SECRET, TOKEN = "a-secret-that-nobody-may-see", "a-token-that-nobody-may-see"
BUCKET = "studies"
# Fewer attempts of the driver, for tests in which all of them fail.
IMPATIENT = {"AWS_MAX_ATTEMPTS": "2"}
_REQUEST = re.compile(r'"(?:\x1b\[\d+m)*([A-Z]+) (\S+) HTTP')


@dataclass
class Server:
    """A running server.

    Attributes:
        url: Endpoint of the server.
    """

    url: str
    process: subprocess.Popen[str]
    _log: list[str] = field(default_factory=list)

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
        # Imported late: it takes a second.
        import boto3
        from botocore.config import Config

        return boto3.client(
            service,
            endpoint_url=self.url,
            aws_access_key_id="tester",
            aws_secret_access_key=SECRET,
            region_name="us-east-1",
            config=Config(retries={"max_attempts": 1}),
        )

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below a prefix."""
        pages = self.client().get_paginator("list_objects_v2").paginate(Bucket=BUCKET, Prefix=prefix)
        return [entry["Key"] for page in pages for entry in page.get("Contents", ())]

    def enforce(self, enforced: bool) -> None:
        """Let the server check signatures and policies from now on, or no longer."""
        data = b"0" if enforced else b"inf"
        # As a form, the default, the number would be read as a name.
        request = urllib.request.Request(f"{self.url}/moto-api/reset-auth", data, {"Content-Type": "text/plain"})
        urllib.request.urlopen(request).close()

    def requests(self) -> list[tuple[str, str]]:
        """Return method and path of every request since the last call."""
        marker = f"/marker-{time.monotonic_ns()}"
        # The bucket does not exist, but once this request is in the log, all earlier ones are.
        with suppress(urllib.error.HTTPError):
            urllib.request.urlopen(self.url + marker).close()
        while not any(marker in line for line in list(self._log)):
            time.sleep(0.01)
        lines, self._log = self._log, []
        matches = [match.groups() for line in lines if (match := _REQUEST.search(line)) and "/marker-" not in line]
        return [(method, path) for method, path in matches]

    def listen(self) -> None:
        """Collect the server's log, so that it never waits for a reader."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._log.append(line)


def forget_drivers() -> None:
    """Make the drivers read their environment again."""
    fsspec.get_filesystem_class("s3").clear_instance_cache()


@contextmanager
def taken_for_s3(environment: Mapping[str, str]) -> Iterator[None]:
    """Make this process, and all that it starts meanwhile, use a server as S3."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        forget_drivers()
        yield
        forget_drivers()


@contextmanager
def serving() -> Iterator[Server]:
    """Run a server with one empty bucket, on a free port."""
    command = [sys.executable, "-u", "-m", "tests.support.s3_server"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            url = next(found[0] for line in process.stderr if (found := re.search(r"http://127\.0\.0\.1:\d+", line)))
            server = Server(url, process)
            listener = threading.Thread(target=server.listen)
            listener.start()
            server.client().create_bucket(Bucket=BUCKET)
            yield server
        finally:
            process.kill()
            listener.join()
