"""Requests to end (Ctrl-C, or the SIGTERM of a job at its time limit) as exceptions that cannot get lost."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

# By then the finalizer has returned.
_AGAIN_SECONDS = 0.01


class Terminated(SystemExit):
    """The process was asked to end by SIGTERM."""


def raise_when_asked() -> None:
    """Raise KeyboardInterrupt and `Terminated` in the main thread when the process is asked to end.

    Python only reports an exception that a signal raises within a finalizer. It is then raised again.
    """
    signal.signal(signal.SIGTERM, _terminate)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as for commands in the background
        signal.signal(signal.SIGINT, _interrupt)
    if not hasattr(signal, "setitimer"):  # Windows
        return
    report = sys.unraisablehook

    def insist(lost: UnraisableHookArgs) -> None:
        if not isinstance(lost.exc_value, KeyboardInterrupt | Terminated):
            report(lost)
            return
        asked = type(lost.exc_value)

        def ask_again(number: int, frame: FrameType | None) -> None:
            raise asked

        signal.signal(signal.SIGALRM, ask_again)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_SECONDS)

    sys.unraisablehook = insist


@contextmanager
def terminations_as_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM as well, for work that ends with what it has."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def ignore_requests() -> None:
    """Ignore further requests, which would change how an ending process ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)


def _terminate(number: int, frame: FrameType | None) -> None:
    _silence_cancellations()
    raise Terminated


def _interrupt(number: int, frame: FrameType | None) -> None:
    _silence_cancellations()
    raise KeyboardInterrupt


def _silence_cancellations() -> None:
    """Keep the event loop of Dask's client from printing a traceback for each call that the request cancels."""
    logging.getLogger("tornado.application").setLevel(logging.CRITICAL)
