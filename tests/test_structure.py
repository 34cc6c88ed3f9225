"""Imports of the package run one way, between its folders and within them; its public names are one list."""

from __future__ import annotations

import inspect
import re
import tomllib
from collections import Counter
from graphlib import CycleError, TopologicalSorter

import pytest

import sobolev_batch as sb
from tests.support.repository import MODULES, PACKAGE, ROOT, imported, public_names

# Each may import those before it.
LAYERS = (
    *(
        "arrays",
        "visible",
        "shown",
        "errors",
        "plugins",
        "parameters",
        "machine",
        "compiled",
        "geometry",
        "sources",
        "transform",
        "norms",
        "reduction",
        "study",
        "store",
    ),
    *("tables", "batch", "testing", "shapes", "result_types", "cli", "extras"),
)

Path = tuple[str, ...]


def modules() -> dict[str, Path]:
    found = {}
    for file in PACKAGE.rglob("*.py"):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(["sobolev_batch", *(part for part in parts if part != "__init__")])] = parts
    return found


@pytest.fixture(scope="module")
def arrows() -> list[tuple[Path, Path]]:
    """Each import of one module by another. The package's own door opens onto everything."""
    known = modules()
    found = [
        (parts, known[module])
        for own, parts in known.items()
        if parts[0] not in ("__init__", "__main__")
        for name in imported(PACKAGE.joinpath(*parts).with_suffix(".py"))
        for module in [name if name in known else name.rpartition(".")[0]]
        if module in known and module != own
    ]
    assert len(found) > 300
    return found


@pytest.mark.slow
def test_layers_know_only_those_below(arrows: list[tuple[Path, Path]]) -> None:
    backwards = [(a, b) for a, b in arrows if LAYERS.index(a[0]) < LAYERS.index(b[0])]
    assert not backwards


def test_nothing_but_the_extras_names_one_of_them() -> None:
    # Public names are a list of places, and plugins find the extras by their folder.
    listed = {"__init__.pyi", "result_types.pyi", "plugins.py"}
    for file in PACKAGE.rglob("*.py*"):
        parts = file.relative_to(PACKAGE).parts
        if parts[0] not in ("extras", *listed) and file.suffix in (".py", ".pyi"):
            assert "sobolev_batch.extras" not in file.read_text(encoding="utf-8"), file


def test_no_folder_and_no_module_is_in_a_circle(arrows: list[tuple[Path, Path]]) -> None:
    # At every depth: the folders of a folder, and the modules in the innermost ones.
    for depth in range(1, max(len(a) for a, _ in arrows) + 1):
        graph: dict[Path, set[Path]] = {}
        for a, b in arrows:
            if a[:depth] != b[:depth]:
                graph.setdefault(a[:depth], set()).add(b[:depth])
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            pytest.fail(" -> ".join("/".join(parts) for parts in error.args[1]))


def test_no_two_modules_have_one_name() -> None:
    names = Counter(parts[-1] for parts in modules().values() if not parts[-1].startswith("__"))
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.slow
@pytest.mark.parametrize("layer", ["geometry", "sources", "transform", "norms", "reduction"])
def test_numbers_know_neither_dask_nor_zarr(layer: str) -> None:
    files = list((PACKAGE / layer).rglob("*.py"))
    assert len(files) > 3
    for file in files:
        assert not {name.split(".")[0] for name in imported(file)} & {"dask", "distributed", "zarr"}, file


def test_the_core_imports_whatever_is_required() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    required = {re.split("[>=<]", line)[0].replace("-", "_") for line in project["dependencies"]}
    required = {name.removeprefix("lib") for name in required}  # libigl is imported as igl
    required.remove("cryptography")  # distributed imports it
    files = [PACKAGE.joinpath(*parts).with_suffix(".py") for parts in modules().values() if parts[0] != "extras"]
    assert required <= {name.split(".")[0] for file in files for name in imported(file)}


@pytest.mark.extras
def test_names_are_sorted_and_unknown_ones_refused() -> None:
    for module in (sb, *MODULES.values()):
        assert module.__all__ == sorted(set(module.__all__))
    assert {"Study", "plan", "run", "status", "table", "matrix", "report", *MODULES} <= set(sb.__all__)
    assert dir(sb) == sb.__all__
    # Each name has one place.
    names = [name for name in public_names() if not name.startswith("plot.")]
    assert len(names) == len({name.split(".")[-1] for name in names})
    with pytest.raises(AttributeError, match="nothing"):
        sb.nothing  # type: ignore[attr-defined]  # noqa: B018


def test_all_errors_are_listed() -> None:
    kinds = {
        name
        for name, value in vars(sb.errors).items()
        if isinstance(value, type) and value.__module__ == sb.errors.__name__
    }
    assert set(sb.errors.__all__) == kinds


@pytest.mark.extras
def test_names_are_sorted_and_unknown_ones_refused_begins_with_names_of_types() -> None:
    # A type that is written out takes a screen, before the first word about the function.
    functions = {name: value for name, value in public_names().items() if inspect.isfunction(value)}
    assert {name for name, one in functions.items() if len(str(inspect.signature(one))) > 700} == set()
