"""python -m sobolev_batch, and the command sobolev-batch: the command line, from its first moment on."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line; the process ends with its exit status."""
    # The command line takes a second to import, in which some library may catch what an interrupt raises.
    before = signal.signal(signal.SIGINT, _leave)
    from sobolev_batch import cli

    signal.signal(signal.SIGINT, before)
    cli.main()


def _leave(number: int, frame: FrameType | None) -> None:
    sys.stderr.write("interrupted before anything was begun\n")
    sys.stderr.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
