"""Nothing that is read is unpickled, evaluated or imported: what could do so does not occur in the sources."""

from __future__ import annotations

import ast
from collections.abc import Iterator

import pytest

from sobolev_batch import Study, StudyError
from tests.support.repository import PACKAGE
from tests.support.studies import small_table

FORBIDDEN_MODULES = {"dill", "joblib", "marshal", "runpy", "shelve", "subprocess", "yaml"}
FORBIDDEN = {
    *("eval", "exec", "compile", "__import__", "import_module", "system", "popen", "Unpickler"),
    *("read_pickle", "load_source", "spawnl", "spawnv", "execv", "execvp"),
}
# pickle.dumps sends a plugin to workers, as code where cloudpickle is told so; what arrives there Dask unpickles.
ALLOWED_OF_PICKLE = {"dumps", "register_pickle_by_value"}
# Of bytes that it has just made itself.
ALLOWED_LOADS = {("surfaces/sources/conformance.py", "loads")}
# Of CUDA's libraries, and of the package's own modules, by names that stand in these modules.
ALLOWED_IMPORTS = {("spectral/backends.py", "import_module"), ("__init__.py", "import_module")}
# Of this interpreter, with a script of the package and two files of its own making.
ALLOWED_PROCESSES = {"results/figures/views.py"}


def calls(tree: ast.AST) -> Iterator[tuple[str, str, ast.Call]]:
    """What is called: the name before the last dot, the name after it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Attribute):
                value = node.func.value
                yield (value.id if isinstance(value, ast.Name) else ""), node.func.attr, node
            elif isinstance(node.func, ast.Name):
                yield "", node.func.id, node


def offences(source: str, name: str = "") -> list[str]:
    """What a source has that could run what it reads."""
    tree = ast.parse(source)
    found = []
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
            if node.module in ("pickle", "cloudpickle"):
                found.append(f"from {node.module} import")
        found += [top for top in (module.split(".")[0] for module in names) if top in FORBIDDEN_MODULES]
    if name in ALLOWED_PROCESSES:
        found.remove("subprocess")
    for module, attribute, call in calls(tree):
        constant = bool(call.args) and isinstance(call.args[0], ast.Constant)
        if module == "re" and attribute == "compile":
            continue
        if attribute == "import_module" and constant:
            continue
        if attribute in FORBIDDEN and (name, attribute) not in ALLOWED_IMPORTS:
            found.append(attribute)
        allowed = attribute in ALLOWED_OF_PICKLE or (name, attribute) in ALLOWED_LOADS
        if module in ("pickle", "cloudpickle") and not allowed:
            found.append(f"{module}.{attribute}")
        for keyword in call.keywords:
            true = not (isinstance(keyword.value, ast.Constant) and not keyword.value.value)
            if keyword.arg in ("allow_pickle", "shell") and true:
                found.append(f"{keyword.arg}=")
        if (module, attribute) == ("np", "load") and "allow_pickle" not in {word.arg for word in call.keywords}:
            found.append("np.load without allow_pickle=False")
    return found


@pytest.mark.slow
def test_no_source_can_run_what_it_reads() -> None:
    paths = sorted(PACKAGE.rglob("*.py"))
    assert len(paths) > 50
    found = {path: offences(path.read_text(encoding="utf-8"), path.relative_to(PACKAGE).as_posix()) for path in paths}
    assert {path: offence for path, offence in found.items() if offence} == {}


@pytest.mark.parametrize(
    "source",
    [
        *("import pickle\npickle.loads(b'')", "from pickle import loads", "import pickle\npickle.Unpickler(f)"),
        *("eval('1')", "exec(text)", "__import__(name)", "importlib.import_module(name)", "import_module(name)"),
        *("np.load(f, allow_pickle=True)", "np.load(f, allow_pickle=flag)", "np.load(f)", "import yaml"),
        *("os.system('ls')", "import subprocess", "run(line, shell=True)", "from dill import loads"),
    ],
)
def test_what_is_looked_for_is_found(source: str) -> None:
    assert offences(source)


@pytest.mark.parametrize(
    "name", ["os:system", "os.system", "sobolev_batch.surfaces.sources.files:FileSource", "../files", "builtins"]
)
def test_sources_are_looked_up_among_entry_points_alone(name: str) -> None:
    with pytest.raises(StudyError, match="no source is named"):
        Study.from_table(small_table(reference={"source": name}))
    nested = {"name": "a", "source": "decimate", "triangles": [4], "mesh": {"source": name}}
    with pytest.raises(StudyError, match="no source is named"):
        Study.from_table(small_table(family=[nested]))
