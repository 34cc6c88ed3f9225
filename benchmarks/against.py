"""Compare this checkout with another commit: python -m benchmarks.against REVISION --only 1 2.

Both run the same items in turns, each in processes of its own, so that a drift of the machine's speed meets both alike.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from tabulate import tabulate

_ROOT = Path(__file__).parents[1]
# Items whose times this project promises not to worsen.
_ITEMS = ("1", "2", "5", "6")


def main() -> None:
    """Print the figures of both, and their ratios."""
    options = _options()
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(_ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "--quiet", str(other), options.revision], check=True)
        try:
            roots = {"this": _ROOT, "other": other}
            checkouts = {
                name: _Checkout.installed(root, Path(folder) / f"{name}-installed") for name, root in roots.items()
            }
            figures = _measured(checkouts, options.only, options.turns)
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)
    rows = []
    for (item, what), of_each in figures.items():
        this, before = median(of_each["this"]), median(of_each["other"])
        rows.append((item, what, f"{this:.4g}", f"{before:.4g}", f"{this / before:.3f}"))
    print(tabulate(rows, ("item", "what", "this", options.revision, "ratio"), disable_numparse=True))


@dataclass(frozen=True)
class _Checkout:
    """A checkout, and the folder into which it was installed: its sources are found by its own entry points."""

    root: Path
    packages: Path

    @classmethod
    def installed(cls, root: Path, packages: Path) -> _Checkout:
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        subprocess.run([*pip, "--target", str(packages), str(root)], check=True)
        return cls(root, packages)


def _measured(
    checkouts: dict[str, _Checkout], items: list[str], turns: int
) -> dict[tuple[str, str], dict[str, list[float]]]:
    """The package's own figures of each row with a unit, by item and description, for each checkout."""
    figures: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for item in items:
        for turn in range(turns):
            for name, checkout in checkouts.items():
                print(f"item {item}, turn {turn + 1} of {turns}: {name}", file=sys.stderr, flush=True)
                for what, figure in _figures(checkout, item).items():
                    figures[item, what][name].append(figure)
    return {row: of_each for row, of_each in figures.items() if len(of_each) == len(checkouts)}


def _figures(checkout: _Checkout, item: str) -> dict[str, float]:
    with tempfile.NamedTemporaryFile(suffix=".md") as table:
        command = [sys.executable, "-m", "benchmarks", "--only", item, "--repeats", "3", "--markdown", table.name]
        environment = {**os.environ, "PYTHONPATH": str(checkout.packages)}
        subprocess.run(command, cwd=checkout.root, env=environment, check=True, stdout=subprocess.DEVNULL)
        text = Path(table.name).read_text(encoding="utf-8")
    rows = re.findall(r"^\| *\S+ *\| *(.+?) *\| *([\d.e+-]+) (?:s|kB|MB|GB) *\|", text, re.MULTILINE)
    return {what: float(figure) for what, figure in rows}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description="This checkout beside another.")
    parser.add_argument("revision", help="a commit, tag or branch")
    parser.add_argument("--only", nargs="+", default=list(_ITEMS), metavar="ITEM", help="items of python -m benchmarks")
    parser.add_argument("--turns", type=int, default=3, metavar="N", help="runs of each [3]")
    return parser.parse_args()


if __name__ == "__main__":
    main()
