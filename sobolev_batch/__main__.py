"""Entry point of the command line: ``sobolev-batch``, or ``python -m sobolev_batch``."""

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line and end the process with its exit status."""
    # Matrix products of commands are small: threads of OpenBLAS that spin for the next one took a fifth of the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # The import takes a second, in which a library may catch the exception of an interrupt.
    before = {number: signal.signal(number, _leave) for number in (signal.SIGINT, signal.SIGTERM)}
    from sobolev_batch import cli

    for number, handler in before.items():
        signal.signal(number, handler)
    cli.main()


def _leave(number: int, frame: FrameType | None) -> None:
    sys.stderr.write("interrupted before anything began\n")
    sys.stderr.flush()
    os._exit(128 + number)


if __name__ == "__main__":
    main()
