"""Serve S3 by moto, on a free port, with conditional writes in one step, as those of S3 are.

Moto looks for the key and writes it in two steps. Of several writers at once, two may then find nothing there.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext
from threading import Lock
from typing import Any

from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from werkzeug.serving import run_simple

_one_at_a_time = Lock()


class Application(DomainDispatcherApplication):
    """Moto's application, in which one conditional request is answered at a time."""

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        """Answer a request."""
        with _one_at_a_time if "HTTP_IF_NONE_MATCH" in environ else nullcontext():
            answer: Iterable[bytes] = super().__call__(environ, start_response)
        return answer


if __name__ == "__main__":
    application = Application(create_backend_app)
    run_simple("127.0.0.1", 0, application, threaded=True, request_handler=MotoRequestHandler)
