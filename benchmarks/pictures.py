"""Make the pictures of docs/pictures anew: ``python -m benchmarks.pictures``, or ``make pictures``.

Studies run into storage/, where finished ones are kept. Pictures of Spot the cow need a folder with spot_23k.obj;
without it they are skipped. The file digests.json has a digest of what each picture was drawn from, which
tests/test_pictures.py compares: the study, and the code that draws, without its comments and docstrings.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import re
import shutil
import subprocess
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "pictures"
DIGESTS = FOLDER / "digests.json"
LARGEST_BYTES = 100_000
# Code is followed through imports from these; what they take from elsewhere computes numbers, and draws nothing.
_DRAWING = "sobolev_batch.extras.figures", "benchmarks.reconstruction", "benchmarks.pictures"
_PAGE = [f"sobolev_batch/extras/report/page/{name}" for name in ("report.css", "charts.js", "study.html.jinja")]


@dataclass(frozen=True)
class Picture:
    """A picture.

    Attributes:
        draw: Function of the folder with the cow's meshes, and of the file to write.
        code: Functions that draw, as module:name.
        files: Studies and other files that it is drawn from, relative to the repository.
        is_cow: True where it needs the meshes of the cow.
    """

    draw: Callable[[Path, Path], None]
    code: tuple[str, ...]
    files: tuple[str, ...] = ()
    is_cow: bool = False

    @property
    def digest(self) -> str:
        """Digest of the code and the files."""
        found: dict[str, str] = {}
        for place in self.code:
            module, name = place.split(":")
            _collect(module, name, found)
        texts = {name: _content(ROOT / name) for name in self.files}
        return hashlib.sha256(json.dumps([found, texts], sort_keys=True).encode()).hexdigest()[:16]


def _content(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return quickstart()
    return tomllib.loads(text) if path.suffix == ".toml" else text


def _collect(module: str, name: str, found: dict[str, str]) -> None:
    """Collect the code of a name at the top of a module, and of all that it uses, as far as that draws."""
    place = f"{module}:{name}"
    if place in found or not module.startswith(_DRAWING):
        return
    for node in _parsed((ROOT / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if name == (alias.asname or alias.name):
                    _collect(node.module, alias.name, found)
        elif name in _defined(node):
            for part in ast.walk(node):
                body = getattr(part, "body", None)
                if isinstance(body, list) and body and isinstance(part, ast.FunctionDef | ast.ClassDef):
                    part.body = [line for line in body if not _is_text(line)] or [ast.Pass()]
            found[place] = ast.dump(node)
            for part in ast.walk(node):
                if isinstance(part, ast.Name):
                    _collect(module, part.id, found)


@cache
def _parsed(text: str) -> ast.Module:
    return ast.parse(text)


def _defined(node: ast.stmt) -> list[str]:
    """Return the names that a statement at the top of a module defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def quickstart() -> str:
    """Return the code of the README that draws its first picture."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    return next(str(block) for block in blocks if ".plot" in block)


def _store(study: str | dict[str, Any], folder: Path = ROOT) -> Path:
    """Run a study, from a file or a table, into the store of its name, and return the store."""
    import sobolev_batch as sb

    table = tomllib.loads((ROOT / study).read_text(encoding="utf-8")) if isinstance(study, str) else study
    place = ROOT / "storage" / f"{table['study']['name']}.zarr"
    sb.run(sb.Study.from_table(table, folder=folder), place, on_progress=print)
    return place


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=150)


def _draw_quickstart(_: Path, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    place = _store("workflows/brain.toml")
    exec(quickstart().replace("storage/brain.zarr", str(place)), {})
    plt.gcf().savefig(path, dpi=120, bbox_inches="tight")


def _draw_plot(kind: str, study: str, orders: tuple[float, ...] | None, _: Path, path: Path) -> None:
    from sobolev_batch.extras.figures.drawing import PLOTS
    from sobolev_batch.extras.figures.selection import Selection
    from sobolev_batch.tables.open import open_store

    selection = Selection.from_store(open_store(str(_store(study))), orders)
    _save(PLOTS[kind].figure(selection), path)


def _draw_witnesses(store: Path, folder: Path, meshes: list[str], order: float, colors: Any, path: Path) -> None:
    from sobolev_batch.extras.figures.selection import Selection
    from sobolev_batch.extras.figures.views import write_witness_plots

    with tempfile.TemporaryDirectory() as made:
        selection = Selection.from_store(str(store), order)
        _, missing = write_witness_plots(selection, made, folder, meshes, colors=colors)
        if missing:
            raise SystemExit(f"meshes are not drawn: {missing}")
        shutil.copy(Path(made) / "witness.png", path)


def _draw_cortices(_: Path, path: Path) -> None:
    store = _store("workflows/cortex.toml")
    _draw_witnesses(store, ROOT, ["decimated/1280", "remeshed/1280", "levels/3"], -4.0, "own", path)


def _cow_study(name: str, orders: list[float], *families: dict[str, Any]) -> dict[str, Any]:
    cow = {"source": "files", "paths": ["spot_23k.obj"]}
    return {
        "study": {"name": name},
        "accuracy": {"rtol": 1e-2},
        "norm": {"orders": orders},
        "mesh": {"cow": cow},
        "reference": {"mesh": "cow"},
        "family": list(families),
    }


def _draw_one_per_cent(meshes: Path, path: Path) -> None:
    import numpy as np

    import sobolev_batch as sb

    cow = sb.read_mesh(meshes / "spot_23k.obj")
    centres = cow.vertices[cow.triangles].mean(axis=1)
    patch = np.linalg.norm(centres - [-0.297, 0.133, 0.191], axis=1) < 0.063
    with tempfile.TemporaryDirectory() as made:
        shutil.copy(meshes / "spot_23k.obj", made)
        twice = sb.Mesh(cow.vertices, np.concatenate([cow.triangles, cow.triangles[patch]]))
        sb.write_mesh(twice, f"{made}/patch.ply")
        radius, sizes = cow.bounding_sphere[1], np.random.default_rng(0).standard_normal(len(cow.vertices))
        moves = 0.0015 * radius * sizes[:, None] * cow.to_trimesh().vertex_normals
        sb.write_mesh(sb.Mesh(cow.vertices + moves, cow.triangles), f"{made}/noisy.ply")
        study = _cow_study(
            "one-per-cent",
            [-2.0],
            {"name": "decimated", "source": "decimate", "mesh": "cow", "triangles": [1360]},
            {"name": "noisy", "source": "files", "paths": ["noisy.ply"]},
            {"name": "duplicated", "source": "files", "paths": ["patch.ply"]},
        )
        store = _store(study, Path(made))
        _draw_witnesses(store, Path(made), ["decimated/*", "noisy/*", "duplicated/*"], -2.0, "common", path)


def _draw_usual_distances(_: Path, path: Path) -> None:
    from matplotlib.figure import Figure

    from sobolev_batch.extras.figures.style import draw_curve, set_log_scale, style_of
    from sobolev_batch.tables.convergence import table
    from sobolev_batch.tables.open import open_store

    study = tomllib.loads((ROOT / "workflows/cortex.toml").read_text(encoding="utf-8"))
    study |= {"study": {"name": "cortex-usual"}, "norm": {"orders": [-2.0]}, "proximity": {}}
    study["family"] = [family for family in study["family"] if family["name"] == "decimated"]
    tree = open_store(str(_store(study)))
    rows = table(tree)
    rows = rows[rows["family"] == "decimated"].set_index("mesh")
    # From the unit of the file to the radius of the bounding sphere of the reference, one unit of the study.
    usual = (
        tree["proximity"].to_dataset().sel(mesh=rows.index.to_numpy()) * json.loads(tree.attrs["similarity"])["scale"]
    )
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    set_log_scale(axes, "xy")
    curves = {
        "Hausdorff / radius": (usual["hausdorff"], 0 * usual["hausdorff"]),
        "Chamfer / radius": (usual["chamfer"], usual["chamfer_error"]),
        "Sobolev, order -2, relative": (rows["relative"], rows["relative_error"]),
    }
    for i, (label, (values, errors)) in enumerate(curves.items()):
        draw_curve(axes, rows["triangles"].to_numpy(), values.to_numpy(), errors.to_numpy(), style_of(i), label)
    axes.set_xlabel("number of triangles")
    axes.set_ylabel("distance")
    axes.legend(fontsize="small")
    _save(figure, path)


def _draw_tolerance(meshes: Path, path: Path) -> None:
    """Draw the fewest triangles within tolerances; mmgs_O3, the program of Mmg, is to be on the path."""
    import numpy as np
    from matplotlib.figure import Figure

    import sobolev_batch as sb
    from sobolev_batch.extras.figures.style import draw_curve, set_log_scale, style_of

    cow = sb.read_mesh(meshes / "spot_23k.obj")
    radius = cow.bounding_sphere[1]
    command = ["mmgs_O3", "-in", "{input}", "-out", "{output}", "-hausd", "{hausd}", "-v", "0"]
    mmg: dict[str, Any] = {"source": "command", "command": command, "input": ".mesh", "output": ".mesh"}
    methods: dict[str, Any] = {"decimation": "decimate", "mmg": mmg, "pyacvd": "remesh"}
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    set_log_scale(axes, "xy")
    for number, (label, method) in enumerate(methods.items()):
        places, values = [], []
        # Even triangles within less are nearly all of the cow's, or more.
        for tolerance in (0.05, 0.02, 0.01) if method == "remesh" else (0.05, 0.02, 0.01, 0.005):
            within = tolerance * radius
            ends = {"hausd": (0.01 * within, 3 * within)} if method is mmg else None
            found = sb.reduce(cow, within, method=method, search=ends, workers=1)["mesh"].bracket
            if found.best is not None:
                places.append(tolerance)
                values.append(found.best.triangles)
        draw_curve(axes, np.array(places), np.array(values), np.zeros(len(values)), style_of(number), label)
    axes.set_xlabel("largest deviation / radius")
    axes.set_ylabel("triangles of Spot the cow")
    axes.legend(fontsize="small")
    _save(figure, path)


def _draw_head(_: Path, path: Path) -> None:
    from benchmarks.reconstruction import draw_row, head_with_ears, reconstructed

    target = head_with_ears(6)
    fits = {f"order {order:g}": reconstructed(target, order, 150) for order in (-4.0, -2.0, -1.0)}
    draw_row({**fits, "target": target}, path, "z")


def _draw_stages(meshes: Path, path: Path) -> None:
    from benchmarks.reconstruction import draw_row, reconstructed, unit_mesh

    cow = unit_mesh(meshes / "spot_23k.obj")
    draw_row({**{f"{n} steps": reconstructed(cow, -2.0, n) for n in (5, 20, 60, 150)}, "target": cow}, path, "y")


def _draw_report(_: Path, path: Path) -> None:
    import sobolev_batch as sb

    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("report.png is a screenshot, and needs the browser Chromium")
    with tempfile.TemporaryDirectory() as made:
        page = sb.report(_store("workflows/cortex.toml"), Path(made) / "report.html", folder=ROOT)
        flags = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=20000"]
        options = [f"--screenshot={path}", "--window-size=1000,1500", "--force-device-scale-factor=1"]
        subprocess.run([browser, *flags, *options, page.as_uri()], check=True, timeout=120)


_FIGURES = "sobolev_batch.extras.figures."
_PLOT = ("benchmarks.pictures:_draw_plot", f"{_FIGURES}style:Plot", f"{_FIGURES}style:draw_curve")
_WITNESS = ("benchmarks.pictures:_draw_witnesses", f"{_FIGURES}views:write_witness_plots")
_FITTED, _CORTEX, _FLOW = "workflows/cortex-fitted.toml", "workflows/cortex.toml", "workflows/flow.toml"
_BRAIN = "workflows/brain.toml"
_ROW = ("benchmarks.reconstruction:draw_row", "benchmarks.reconstruction:reconstructed")
PICTURES = {
    "quickstart": Picture(_draw_quickstart, ("benchmarks.pictures:_draw_quickstart",), ("README.md", _BRAIN)),
    "cortex-convergence": Picture(
        partial(_draw_plot, "convergence", _FITTED, (-1.5, -4.0)),
        (*_PLOT, f"{_FIGURES}drawing:draw_convergence"),
        (_FITTED,),
    ),
    "cortex-energy": Picture(
        partial(_draw_plot, "energy", _FITTED, None), (*_PLOT, f"{_FIGURES}drawing:draw_energy"), (_FITTED,)
    ),
    "cortex-witness": Picture(_draw_cortices, ("benchmarks.pictures:_draw_cortices", *_WITNESS), (_CORTEX,)),
    "usual-distances": Picture(
        _draw_usual_distances, ("benchmarks.pictures:_draw_usual_distances", f"{_FIGURES}style:draw_curve"), (_CORTEX,)
    ),
    "flow-over-time": Picture(
        partial(_draw_plot, "over-time", _FLOW, None), (*_PLOT, f"{_FIGURES}drawing:draw_evolution"), (_FLOW,)
    ),
    "report": Picture(_draw_report, ("benchmarks.pictures:_draw_report",), (_CORTEX, *_PAGE)),
    "one-per-cent": Picture(_draw_one_per_cent, ("benchmarks.pictures:_draw_one_per_cent", *_WITNESS), is_cow=True),
    "tolerance": Picture(
        _draw_tolerance, ("benchmarks.pictures:_draw_tolerance", f"{_FIGURES}style:draw_curve"), is_cow=True
    ),
    "reconstruction": Picture(_draw_head, ("benchmarks.pictures:_draw_head", *_ROW)),
    "reconstruction-stages": Picture(_draw_stages, ("benchmarks.pictures:_draw_stages", *_ROW), is_cow=True),
}


def _shrink(path: Path) -> None:
    """Reduce the colours of a PNG to those of a palette; refuse one that is still too large."""
    from PIL import Image

    with Image.open(path) as image:
        whole = image.convert("RGB")
    for colors in (256, 64):
        whole.quantize(colors).save(path, optimize=True)
        if path.stat().st_size <= LARGEST_BYTES:
            return
    raise SystemExit(f"{path} has {path.stat().st_size:,} bytes; pictures have at most {LARGEST_BYTES:,}")


def stale() -> Iterator[str]:
    """Yield the names of pictures that are missing or were drawn from something else."""
    known = json.loads(DIGESTS.read_text(encoding="utf-8")) if DIGESTS.exists() else {}
    for name, picture in PICTURES.items():
        if not (FOLDER / f"{name}.png").exists() or known.get(name) != picture.digest:
            yield name


def main() -> None:
    """Draw the pictures that are named, by default the stale ones."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pictures", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="pictures [the stale ones]")
    parser.add_argument("--meshes", type=Path, metavar="FOLDER", help="folder with spot_23k.obj")
    options = parser.parse_args()
    if unknown := set(options.names) - set(PICTURES):
        parser.error(f"no picture is named {', '.join(unknown)}; known are {', '.join(PICTURES)}")
    for name in options.names or list(stale()):
        picture = PICTURES[name]
        if picture.is_cow and options.meshes is None:
            print(f"{name}: skipped; name the folder of its meshes by --meshes")
            continue
        path = FOLDER / f"{name}.png"
        picture.draw(options.meshes, path)
        _shrink(path)
        known = json.loads(DIGESTS.read_text(encoding="utf-8")) if DIGESTS.exists() else {}
        known[name] = picture.digest
        DIGESTS.write_text(json.dumps(dict(sorted(known.items())), indent=2) + "\n", encoding="utf-8")
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
