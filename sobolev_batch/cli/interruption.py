"""Requests to end, Ctrl-C or the SIGTERM of a job at its time limit, which end a command within seconds."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import ClassVar, NoReturn

from sobolev_batch.cli.output import CLEAR_LINE

# Time in which a command ends by itself; a transform may take longer to return to Python.
SECONDS_TO_END = 1.0
# Work that ends with what it has leaves out up to three steps, each when it is asked again.
_SECONDS_TO_LEAVE_OUT = 0.5
_SECONDS_TO_LEAVE_A_FINALIZER = 0.02


class Deadline:
    """The end of this process soon after a request to end, even while it computes.

    Python raises no exception until a library returns to it. A thread of its own hears
    of signals at once. It leaves the command some seconds to clean up, and then ends the process: files and stores are
    only ever replaced as a whole. The remark is added to the last message. The request is the number of the signal that
    requests the end, and 0 before.
    """

    _current: ClassVar[Deadline | None] = None

    def __init__(self) -> None:
        self.expect("", SECONDS_TO_END)
        self.request = 0
        self._has_results: Callable[[], bool] | None = None
        self._is_met = threading.Event()

    def expect(self, remark: str, seconds: float) -> None:
        """Let the command that begins have a remark, and seconds to clean up."""
        self._remark, self._seconds = remark, seconds

    def end(self, number: int) -> NoReturn:
        """End a command that has cleaned up after a request, of this number unless it has another."""
        ignore_requests()
        with suppress(OSError):
            sys.stdout.flush()
        # The interpreter would wait at its end for threads that may still compute.
        end_process(number, self._remark)

    def start(self) -> None:
        """Raise KeyboardInterrupt at Ctrl-C and SystemExit at SIGTERM from now on, and see that the process ends."""
        # Python's tracker of semaphores outlives a process that ends at once and cleans up after it, with a warning
        # that would be the last word.
        sys.warnoptions.append("ignore:resource_tracker:UserWarning")
        signal.signal(signal.SIGTERM, _raising(SystemExit))
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as for commands in the background
            signal.signal(signal.SIGINT, _raising(KeyboardInterrupt))
        Deadline._current = self
        requests, wake = os.pipe()
        os.set_blocking(wake, False)
        sys.unraisablehook = self._raise_again
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        threading.Thread(target=self._listen, args=(requests,), name="sobolev-batch-deadline", daemon=True).start()

    def _raise_again(self, lost: sys.UnraisableHookArgs) -> None:
        """Raise the exception of a request again that came to a finalizer, where Python ignores all exceptions."""
        if lost.exc_type not in (KeyboardInterrupt, SystemExit):
            sys.__unraisablehook__(lost)
            return
        number = signal.SIGINT if lost.exc_type is KeyboardInterrupt else signal.SIGTERM
        again = (threading.main_thread().ident or 0, number)
        threading.Timer(_SECONDS_TO_LEAVE_A_FINALIZER, signal.pthread_kill, again).start()

    def _listen(self, requests: int) -> None:
        number = 0
        while number not in (signal.SIGINT, signal.SIGTERM):
            number = os.read(requests, 1)[0]
        self.request = number
        while not self._is_met.wait(_SECONDS_TO_LEAVE_OUT if self._has_results else self._seconds):
            if self._has_results is None or not self._has_results():
                end_process(number, self._remark)
            # It keeps what it has, and is to leave out whatever else takes long.
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    @classmethod
    @contextmanager
    def with_results(cls, has_results: Callable[[], bool]) -> Iterator[None]:
        """Raise KeyboardInterrupt at each request, SIGTERM too, for work that ends with what it has.

        Another thread asks whether there is anything yet.
        """
        before = signal.signal(signal.SIGTERM, _raising(KeyboardInterrupt))
        deadline = cls._current or Deadline()
        deadline._has_results = has_results
        try:
            yield
            if deadline.request:
                # What is left to do is short, and nothing may come between.
                deadline._is_met.set()
                ignore_requests()
        finally:
            deadline._has_results = None
            if not deadline._is_met.is_set():
                signal.signal(signal.SIGTERM, before)


def end_process(number: int, remark: str) -> NoReturn:
    """End this process at once, with the last message and the status that shells expect: 130 or 143."""
    word = "interrupted" if number == signal.SIGINT else "terminated"
    with suppress(OSError):
        os.write(2, f"{CLEAR_LINE * os.isatty(2)}{word}{remark}\n".encode())
    os._exit(128 + number)


def ignore_requests() -> None:
    """Ignore further requests, which would change how an ending process ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _raising(error: type[BaseException]) -> Callable[[int, FrameType | None], None]:
    def handle(number: int, frame: FrameType | None) -> None:
        # Dask would print a traceback for each call that the request cancels, and for each worker that ends.
        for name in ("tornado.application", "distributed"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        raise error(128 + number)

    return handle
