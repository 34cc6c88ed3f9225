"""The text of a first study file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sobolev_batch.batch.study.draft.mesh_files import MeshFile
from sobolev_batch.visible import HAZARDOUS

# Explicit lists are broken into lines where they are longer.
_LINE = 110
# What the optional decimated family has, as fractions of the triangles of the reference.
_FRACTIONS = (16, 8, 4, 2)
_FEWEST_TRIANGLES = 4

_HEAD = """\
# `sobolev-batch plan` says what this study would do, and how long that takes; `sobolev-batch run` computes it.

[study]
name = {name}

[accuracy]                 # of the distance of every mesh to the reference
rtol = 1e-2                # the largest relative error: 1 % of the distance itself
best_effort = true         # where that is out of reach, compute the nearest that can be had and mark it

[norm]
orders = [-2.0, -4.0]      # -2 weighs details, -4 the overall form; -1.5 sees finer details and takes longer

"""
_TAIL = """
# More to ask for: remove the # in front of the lines.

# [proximity]              # Hausdorff and Chamfer distances beside ours; needs the extra "vtk"
# points = 10000
"""
_DECIMATED = """
[[family]]
name = "quadric decimation"
source = "decimate"
mesh = {{ source = "files", paths = [{path}] }}
triangles = [{sizes}]
"""


@dataclass(frozen=True)
class PathText:
    """Paths of meshes as a study file names them.

    Attributes:
        entries: Paths or globs.
        remark: What they are, for a comment.
    """

    entries: Sequence[str]
    remark: str = ""

    @property
    def lines(self) -> str:
        """The key `paths`, on several lines if it is long."""
        texts = list(map(quoted_text, self.entries))
        comment = f"  # {self.remark}" * bool(self.remark)
        one_line = f"paths = [{', '.join(texts)}]{comment}"
        if len(one_line) <= _LINE:
            return one_line
        return "\n".join([f"paths = [{comment}", *(f"    {text}," for text in texts), "]"])


def quoted_text(text: str) -> str:
    """Return a text as TOML spells it."""
    # JSON spells it in the same way, but leaves some characters as they are that a terminal would obey or hide.
    # Lone surrogates, of names that are no UTF-8, have no spelling, and cannot be written.
    return HAZARDOUS.sub(
        lambda found: found[0] if found[0] >= "\ud800" else f"\\u{ord(found[0]):04x}",
        json.dumps(text, ensure_ascii=False),
    )


def size_text(files: Sequence[MeshFile]) -> str:
    """Return how many meshes there are, and of which sizes."""
    counts = sorted(file.triangles for file in files)
    number = f"{len(files)} mesh" + "es" * (len(files) != 1)
    sizes = f"{counts[0]:,}" if counts[0] == counts[-1] else f"{counts[0]:,} to {counts[-1]:,}"
    return f"{number}, {sizes} triangles"


def study_text(name: str, reference: PathText, families: Mapping[str, PathText], triangles: int) -> str:
    """Return a study of one object; without families, one of its decimated versions.

    Args:
        name: Name of the study.
        reference: Path of the reference.
        families: Paths of each family, by name.
        triangles: Number of triangles of the reference.
    """
    (original,) = reference.entries
    sizes = decimated_sizes(triangles)
    decimated = _DECIMATED.format(path=quoted_text(original), sizes=", ".join(map(str, sizes)))
    if families:
        decimated = "\n# Compare with decimation: remove the # in front of these lines.\n" + _as_comment(decimated)
    return "".join(
        [
            _HEAD.format(name=quoted_text(name)),
            f'[reference]                # {reference.remark}\nsource = "files"\n{PathText(reference.entries).lines}\n',
            *(_family(family, paths) for family, paths in families.items()),
            decimated if sizes else "",
            _TAIL,
        ]
    )


def decimated_sizes(triangles: int) -> list[int]:
    """Return the numbers of triangles of the decimated versions of a mesh: none of a very small one."""
    return [count for part in _FRACTIONS if (count := triangles // part) >= _FEWEST_TRIANGLES]


def objects_text(name: str, references: PathText, meshes: PathText) -> str:
    """Return a study of several objects, whose paths have placeholders."""
    return "".join(
        [
            _HEAD.format(name=quoted_text(name)),
            f'[reference]                # of each object\nsource = "files"\n{references.lines}\n',
            _family("{method}", meshes),
            _TAIL,
        ]
    )


def listed_text(name: str, meshes: Sequence[tuple[str, str, str]]) -> str:
    """Return a study of several objects, whose meshes are listed: object, method, and path of each."""
    rows = [
        f"    {{ object = {quoted_text(one)}, method = {quoted_text(method)}, path = {quoted_text(path)} }},\n"
        for one, method, path in meshes
    ]
    head = _HEAD.format(name=quoted_text(name))
    return "".join([head, "[objects]\nmeshes = [\n", *rows, "]\n", _TAIL])


def _family(name: str, paths: PathText) -> str:
    return f'\n[[family]]\nname = {quoted_text(name)}\nsource = "files"\n{paths.lines}\n'


def _as_comment(lines: str) -> str:
    return "".join(f"# {line}\n" for line in lines.strip().splitlines())
