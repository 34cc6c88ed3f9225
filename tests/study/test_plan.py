"""Plans: labels, the similarity, what identifies a field, what it costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import trimesh

from sobolev_batch import Study
from sobolev_batch.errors import LatticeError, MeshError, StudyError
from sobolev_batch.sources.registry import SurfaceMember
from sobolev_batch.study.plan import make_plan
from tests.support.members import SilentError
from tests.support.studies import small_table


def plan_of(**changes: Any):  # type: ignore[no-untyped-def]
    folder = changes.pop("folder", ".")
    return make_plan(Study.from_table(small_table(**changes), folder=folder))


@pytest.fixture
def box_file(tmp_path: Path) -> Path:
    path = tmp_path / "box.off"
    box = trimesh.creation.box(extents=(2.0, 4.0, 4.0))
    box.apply_translation((10.0, 0.0, 0.0))
    box.export(path)
    return path


def test_the_similarity_takes_the_reference_to_the_unit_sphere_or_is_fixed_or_left_out(box_file: Path) -> None:
    plan = plan_of(reference={"source": "files", "paths": ["box.off"]}, folder=box_file.parent)
    assert plan.similarity.scale == pytest.approx(1 / 3)
    assert plan.similarity.origin == pytest.approx((10.0, 0.0, 0.0))
    ring = {"source": "torus", "R": 2.0, "r": 0.8, "center": [5.0, 0.0, 1.0]}
    for scaling in (None, dict[str, Any]()):
        found = plan_of(reference=ring, scaling=scaling).similarity
        assert (found.scale, found.origin) == (1 / 2.8, (5.0, 0.0, 1.0))
    assert plan_of(reference={"source": "ellipsoid", "axes": [2.0, 1.4, 0.8]}).similarity.scale == 0.5
    assert plan_of(scaling={"mode": "none"}, reference={"source": "sphere", "radius": 0.5}).similarity.is_identity
    fixed = plan_of(scaling={"mode": "fixed", "scale": 0.25, "origin": [1, 0, 0]}).similarity
    assert (fixed.scale, fixed.origin) == (0.25, (1.0, 0.0, 0.0))


def test_the_reference_may_be_a_member_of_a_family(box_file: Path) -> None:
    plan = plan_of(reference={"source": "family", "family": "ico"})
    assert plan.reference == "ico/3"
    assert len(plan.rows) == 4
    assert plan_of(reference={"source": "family", "family": "ico", "member": "1"}).reference == "ico/1"
    with pytest.raises(StudyError, match="has no member '9'"):
        plan_of(reference={"source": "family", "family": "ico", "member": "9"})
    trimesh.creation.box().export(box_file.with_name("a.off"))
    # The same file twice is one surface.
    family = [{"name": "f", "source": "files", "paths": ["box.off", "./box.off", "*.off"]}]
    with pytest.raises(StudyError, match=r"no finest level; name one of its members: a, box$"):
        plan_of(family=family, reference={"source": "family", "family": "f"}, folder=box_file.parent)


@pytest.mark.extras
def test_a_named_mesh_is_the_source_that_it_names(box_file: Path) -> None:
    box, fine = {"source": "files", "paths": ["box.off"]}, {"source": "icosphere", "levels": [3]}
    names = {"box": box, "fine": fine, "coarse": {"source": "decimate", "mesh": "fine", "triangles": [100]}}

    def families(box: Any, fine: Any, coarse: Any) -> list[dict[str, Any]]:
        carried = {"name": "m", "source": "flow", "times": [0.1], "mesh": coarse}
        return [carried, {"name": "f", "source": "fit", "steps": 1, "mesh": fine, "target": box}]

    by_name = [*families("box", "fine", "coarse"), {"name": "b", "mesh": "box"}]
    named = plan_of(mesh=names, reference={"mesh": "box"}, family=by_name, folder=box_file.parent)
    coarse = {"source": "decimate", "mesh": fine, "triangles": [100]}
    in_full = [*families(box, fine, coarse), {"name": "b", **box}]
    written = plan_of(reference=box, family=in_full, folder=box_file.parent)
    assert [(row.label, row.key) for row in named.rows] == [(row.label, row.key) for row in written.rows]
    # By their fingerprints the store of one is that of the other; the study remembers how it was written.
    assert named.study.table["reference"] == {"mesh": "box"}
    assert plan_of(mesh=names, reference="box", folder=box_file.parent).rows[-1].key == named.rows[-1].key


def test_keys_follow_what_a_field_depends_on(box_file: Path) -> None:
    def key(**changes: Any) -> str:
        family = {"name": "f", "source": "files", "paths": ["box.off"]}
        reference = {"source": "sphere", "radius": 20.0}
        plan = plan_of(**{"family": [family], "reference": reference, **changes}, folder=box_file.parent)
        return str(next(row.key for row in plan.rows if row.label == "f/box"))

    before = key()
    assert key(norm={"orders": [-7.0]}) == before
    assert key(study={"name": "small", "title": "other"}) == before
    assert key(transform={"eps": 1e-6}) != before
    assert key(lattice={"xi_max": 3.0, "M": 18}) != before
    assert key(reference={"source": "sphere", "radius": 21.0}) != before
    # What lies beyond a given lattice is measured against a reference with flat faces.
    keys = set()
    for width in (1.0, 2.0):
        trimesh.creation.box(extents=(1.0, 1.0, width)).export(box_file.with_name("flat.off"))
        flat = {"source": "files", "paths": ["flat.off"]}
        keys.add(key(reference=flat, scaling={"mode": "none"}, lattice={"xi_max": 0.5, "M": 64}))
    assert len(keys) == 2
    box_file.write_text(box_file.read_text() + "\n# one more line\n")
    assert key() != before


def test_a_missing_mesh_is_left_to_its_task_and_a_missing_reference_is_not(tmp_path: Path) -> None:
    families = [{"name": "f", "source": "files", "paths": ["no.ply"]}]
    assert plan_of(family=families, folder=tmp_path).rows[0].key == ""
    with pytest.raises(MeshError, match=r"the reference cannot be made: .*no\.ply: cannot be read"):
        plan_of(reference={"source": "files", "paths": ["no.ply"]}, folder=tmp_path)


def test_large_lattices_are_cut_into_chunks_and_small_ones_refused() -> None:
    with pytest.raises(LatticeError, match="take M >= "):
        plan_of(lattice={"xi_max": 5.0, "M": 16}, reference={"source": "icosphere", "levels": [2]})
    with pytest.raises(LatticeError, match=r"the surface reaches to \|coordinate\| = 5, .* holds only"):
        plan_of(reference={"source": "sphere", "radius": 5.0}, scaling={"mode": "none"})
    plan = plan_of(lattice={"xi_max": 20.0, "M": 512})
    sizes = [block.size for block in plan.blocks]
    assert (len(sizes), sum(sizes), plan.field_bytes) == (5, 513 * 513 * 257, 513 * 513 * 257 * 16)
    assert max(sizes) * 16 <= 256 << 20


def test_two_surfaces_of_one_label_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A source of another package may not keep its promise."""
    study = Study.from_table(small_table())
    source = study.object.families[0].source
    members = source.members(study.object.folder)
    monkeypatch.setattr(type(source), "members", lambda self, folder: [*members, members[0]])
    with pytest.raises(StudyError, match="two surfaces of the study have the label 'ico/0'"):
        make_plan(study)


def test_what_a_source_of_another_package_raises_stops_no_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    table = small_table(lattice=None, accuracy={"rtol": 0.3}, reference={"source": "icosphere", "levels": [2]})
    table["family"].append({"name": "ball", "source": "sphere"})
    for name in ("load", "fingerprint"):
        monkeypatch.setattr(SurfaceMember, name, Mock(side_effect=SilentError))
    assert {row.label for row in make_plan(Study.from_table(table)).rows if not row.key} == {"ball/sphere"}
    with pytest.raises(MeshError, match="the reference cannot be made: SilentError"):
        make_plan(Study.from_table({**table, "reference": {"source": "sphere"}}))
