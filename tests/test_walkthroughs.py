"""The walkthroughs of docs/walkthroughs.md run as printed, in a shell of their own, on files such as they are for."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.support.repository import ROOT
from tests.support.walkthroughs import FILES

PAGE = (ROOT / "docs" / "walkthroughs.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S))

# What the reader is told to look for, as regular expressions.
SEEN = {
    "A remesher against others": (r"League at order -4, over 4 objects", "take 9 or more", r"^mine +undecided +0\.\d"),
    "Surfaces of brains": ("correlation with age: 0.9", "shows where s03 differs"),
    "Two hundred scans on a cluster": ("201 of 201 complete", "211 of 211 complete", "nothing is damaged"),
    "A first look at two meshes": ("simple.ply is as far from statue.ply as", "witness: where-a.ply where-b.ply"),
    "A part in millimetres": (r"25\.4 times as small", "exported  exported/middle", "1 passed", "same surface"),
}


def test_every_walkthrough_has_files() -> None:
    assert list(SECTIONS) == list(FILES) == list(SEEN)


@pytest.mark.all
@pytest.mark.parametrize("title", FILES)
def test_it_runs_as_printed(title: str, tmp_path: Path) -> None:
    FILES[title](tmp_path)
    text = SECTIONS[title].replace("8786", str(free_port()))
    commands = ""
    for language, block in re.findall(r"^```(\w+)\n(.*?)^```", text, re.M | re.S):
        if language == "sh":
            # Each begins where the reader has the files.
            commands += f"cd {tmp_path}\n{block}"
        else:
            first, content = block.split("\n", 1)
            (tmp_path / first.removeprefix("# ")).write_text(content)
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        shell = subprocess.Popen(
            ["bash", "-e", "-x", "-c", commands],
            env=os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            assert shell.wait() == 0, log.read_text()
        finally:
            # A scheduler and workers outlive it.
            with suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
    for words in SEEN[title]:
        assert re.search(words, log.read_text(), re.M)


def free_port() -> int:
    """A port of loopback that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
