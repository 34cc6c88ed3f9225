"""python -m sobolev_batch, and the command sobolev-batch: the command line, from its first moment on."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    # The command line takes a second to import, in which some library may catch what an interrupt raises.
    before = {number: signal.signal(number, _leave) for number in (signal.SIGINT, signal.SIGTERM)}
    from sobolev_batch import cli

    for number, handler in before.items():
        signal.signal(number, handler)
    cli.main()


def _leave(number: int, frame: FrameType | None) -> None:
    sys.stderr.write("interrupted before anything was begun\n")
    sys.stderr.flush()
    os._exit(128 + number)


if __name__ == "__main__":
    main()
