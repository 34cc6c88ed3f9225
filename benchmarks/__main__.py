"""The command line: python -m benchmarks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.accuracy import left_to_us, stored_bytes
from benchmarks.devices import on_a_gpu
from benchmarks.fitting import fits
from benchmarks.low_orders import low_orders
from benchmarks.memory import peaks
from benchmarks.peers import peers
from benchmarks.reconstruction import reconstructions
from benchmarks.scale import many_objects, tiny_meshes, waiting_workers
from benchmarks.studies import all_pairs, study_overhead
from benchmarks.table import Row, format_table
from benchmarks.timing import Effort, machine_facts
from benchmarks.tolerance import tolerances
from benchmarks.transforms import against_the_direct_sum, against_the_paper, as_in_the_paper, growth
from benchmarks.verdicts import verdicts

_ITEMS: dict[str, Callable[[Effort], Iterator[Row]]] = {
    "1": against_the_paper,
    "2": left_to_us,
    "3": as_in_the_paper,
    "4": against_the_direct_sum,
    "5": study_overhead,
    "6": all_pairs,
    "7": stored_bytes,
    "8": peaks,
    "9": on_a_gpu,
    "10": low_orders,
    "11": fits,
    "12": reconstructions,
    "13": verdicts,
    "14": tolerances,
    "growth": growth,
    "scale": tiny_meshes,
    "objects": many_objects,
    "waiting": waiting_workers,
    "peers": peers,
}
# Reconstructions take as long as everything else together.
_BY_NAME = ("12",)


def main() -> None:
    """Run the requested benchmarks and print their table."""
    options = _options()
    effort = Effort(options.repeats, options.quick, options.large)
    rows: list[Row] = []
    for item in options.only or [name for name in _ITEMS if options.large or name not in _BY_NAME]:
        for row in _ITEMS[item](effort):
            print("  ".join(filter(None, row.cells())), file=sys.stderr, flush=True)
            rows.append(row)
    facts = [
        *machine_facts(),
        f"times are medians of {effort.repeats} turns each, taken alternately",
        "items 1 to 4: ratios of times are other / ours; items 5 to 7, 9, 11 and 12: ours / other; item 10: processor "
        "seconds, and other / ours against sums; item 13: seconds, and those of Hausdorff and Chamfer distances; "
        "item 14: processor seconds, of searches over those of a single decimation and distance; distances: relative "
        "difference",
    ]
    print("\n".join(["", format_table(rows), "", *facts]))
    if options.markdown:
        lines = ["# Benchmarks", "", *(f"- {fact}" for fact in facts), "", format_table(rows, "github"), ""]
        options.markdown.write_text("\n".join(lines), encoding="utf-8")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="What the package costs, as ratios.")
    parser.add_argument(
        "--only", nargs="+", choices=list(_ITEMS), metavar="ITEM", help=f"of {', '.join(_ITEMS)} [all but 12]"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes that only show that everything works")
    parser.add_argument("--large", action="store_true", help="the sizes that take minutes and gigabytes as well")
    parser.add_argument("--repeats", type=_positive, default=3, metavar="N", help="timed turns of each contestant [3]")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table there too")
    return parser.parse_args()


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"at least 1, found {value}")
    return value


if __name__ == "__main__":
    main()
