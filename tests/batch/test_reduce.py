"""The fewest triangles within a tolerance: what is found holds, and a search goes on wherever it was ended."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client

import sobolev_batch as sb
from sobolev_batch.batch import reduce as module
from sobolev_batch.batch.reduce import Reduction, format_reductions
from sobolev_batch.reduction import limit as limits
from sobolev_batch.reduction.remesher import Remesher
from sobolev_batch.sources.registry import SurfaceMember, load_mesh
from sobolev_batch.store.location import Location
from tests.geometry.test_deviation import distance_from_triangles, grid
from tests.support.commands import call, started

# A remesher that makes rings of this many edges, and none of a thirteenth.
RINGS = "python {folder}/rings.py {input} {output} {edge}"
SCRIPT = """
import math, sys
import sobolev_batch as sb
count = max(3, round(2 * math.pi / float(sys.argv[3])))
if count == 13:
    sys.exit("thirteen edges are refused")
angles = [2 * math.pi * k / count for k in range(count)]
ring = [[math.cos(a), math.sin(a), 0.0] for a in angles]
sb.write_mesh(sb.Mesh([[0.0, 0, 0], *ring], [[0, 1 + k, 1 + (k + 1) % count] for k in range(count)]), sys.argv[2])
"""


def disc(mesh: sb.Mesh, edge: float) -> sb.Mesh:
    """A flat disc within the unit circle, of edges of a length, whatever the mesh."""
    count = max(3, round(2 * np.pi / edge))
    if count == 13:
        raise ValueError("thirteen edges are refused")
    angles = 2 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    spokes = [[0, 1 + k, 1 + (k + 1) % count] for k in range(count)]
    return sb.Mesh(np.concatenate([np.zeros((1, 3)), ring]), spokes)


def lumpy(level: int = 3, scale: float = 1.0) -> sb.Mesh:
    """A lumpy ellipsoid."""
    ball = sb.shapes.icosphere(level)
    x, y, z = ball.vertices.T
    radii = 1 + 0.1 * np.sin(5 * x) * np.cos(4 * y + 1) + 0.05 * np.sin(7 * z)
    return sb.Mesh(scale * radii[:, None] * ball.vertices * [1.0, 0.8, 0.6], ball.triangles)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scans") / "scan.ply"
    sb.write_mesh(lumpy(), path)
    return path


def found_by(*arguments: Any, **options: Any) -> Reduction:
    """The result for one mesh, in this process."""
    (found,) = sb.reduce(*arguments, workers=1, **options).values()
    return found


def sizes(found: Reduction) -> list[float]:
    return [one.size for one in found.trials]


def rows(found: Reduction) -> list[int]:
    """Triangles of the mesh, and of the next smaller one that failed."""
    row = found.to_row()
    return [row["triangles"], row["failed_triangles"]]


def farthest(mesh: sb.Mesh, other: sb.Mesh) -> float:
    """The largest distance of points on a grid, either way, by all triangles."""
    pairs = ((mesh, other), (other, mesh))
    return max(float(distance_from_triangles(grid(a, 3), b).max()) for a, b in pairs)


def test_the_mesh_holds_and_the_next_smaller_one_does_not(tmp_path: Path) -> None:
    from fast_simplification import simplify

    original = lumpy(2)
    sb.write_mesh(original, tmp_path / "scan.ply")
    found = found_by(tmp_path / "scan.ply", within=0.1, output=tmp_path / "reduced")
    best, failed = found.bracket.best, found.bracket.failed
    assert best is not None
    assert failed is not None
    assert (found.original_triangles, found.path) == (320, str(tmp_path / "reduced" / "scan.ply"))
    reduced = sb.read_mesh(found.path)
    assert len(reduced.triangles) == best.triangles < 320 / 2
    # By brute force, which shares no code with the bounds.
    assert best.lower * (1 - 1e-9) <= farthest(reduced, original) <= best.upper <= 0.1
    scale = 100 / original.bounding_sphere[1]
    vertices = (original.vertices - original.bounding_sphere[0]) * scale
    made = simplify(vertices, original.triangles.astype(np.int32), target_count=int(failed.size))
    smaller = sb.Mesh(made[0] / scale + original.bounding_sphere[0], made[1])
    assert len(smaller.triangles) == failed.triangles < best.triangles <= 1.05 * failed.triangles + 1
    assert farthest(smaller, original) > 0.1
    assert len(found.trials) <= 8


def test_a_scan_with_an_open_border_gets_smaller() -> None:
    whole = lumpy(3)
    scan = sb.Mesh(whole.vertices, whole.triangles[whole.vertices[whole.triangles][:, :, 0].max(axis=1) < 0.3])
    # The border moves early if it may.
    found = found_by(scan, within=0.03)
    assert rows(found)[0] < len(scan.triangles) / 2
    assert rows(found_by(scan, within=0.03, method={"source": "decimate", "keep_boundary": False}))[0] > rows(found)[0]


@pytest.mark.slow
def test_a_fraction_of_the_norm_does_not_depend_on_the_unit(tmp_path: Path) -> None:
    found = sb.reduce({"mm": lumpy(), "m": lumpy(scale=1e-3)}, "2%", order=-4, workers=1)
    for one in found.values():
        best, failed = one.bracket.best, one.bracket.failed
        assert best is not None
        assert failed is not None
        assert best.upper <= 0.02 < failed.upper
        assert best.size <= 1.05 * failed.size + 1
    assert rows(found["mm"]) == pytest.approx(rows(found["m"]), rel=0.06)
    mesh = found["mm"].mesh
    assert mesh is not None
    assert sb.testing.same_surface(mesh, lumpy(), tolerance=0.02, order=-4).outcome == "same"


@pytest.mark.parametrize(
    ("measure", "limit"),
    [("rms", 0.03), ("mean", 0.03), ("mean_backward", 0.03), ("p95", 0.05), ("chamfer", 0.05), ("normal_mean", 8.0)],
)
def test_a_number_of_random_points_is_within_the_tolerance_with_its_error(measure: str, limit: float) -> None:
    original, found = lumpy(3), found_by(lumpy(3), limit, measure=measure)
    best, failed = found.bracket.best, found.bracket.failed
    assert best is not None
    assert failed is not None
    assert best.triangles < 640
    assert best.size <= 1.05 * failed.size + 1
    assert best.lower < best.upper <= limit < failed.upper
    assert found.mesh is not None
    # Those of `compare --proximity`, and of more other points.
    numbers, more = sb.proximity(found.mesh, original), sb.proximity(found.mesh, original, points=50_000, seed=1)
    assert best.lower < more[measure] < best.upper
    assert numbers[measure] == pytest.approx((best.lower + best.upper) / 2)
    if f"{measure}_error" in numbers:
        assert (best.upper - best.lower) / 2 == pytest.approx(2.5763 * numbers[f"{measure}_error"], rel=1e-4)
    again = found_by(lumpy(3), limit, measure=measure).bracket.best
    assert again is not None
    assert again.upper == best.upper
    text = format_reductions({"lumpy": found}, unit="mm" if measure != "normal_mean" else None)
    assert f"{measure} " in text
    assert f"within {limit:g}{'°' if measure == 'normal_mean' else ' mm'}: " in text


@pytest.mark.parametrize("measure", ["fscore", "precision", "recall"])
def test_a_score_is_at_least_the_tolerance_with_its_error(measure: str) -> None:
    original, found = lumpy(3), found_by(lumpy(3), "90%", measure=measure)
    best, row = found.bracket.best, found.to_row()
    assert best is not None
    assert found.mesh is not None
    assert best.triangles < 640
    # With the default threshold of `proximity`, of more and other points, and nearer to the tolerance than 5 %.
    more = sb.proximity(found.mesh, original, points=50_000, seed=1)[measure]
    assert 0.9 <= row["lower"] < more < row["upper"] < 0.95
    assert row["failed_lower"] < 0.9
    assert (row["upper"] - row["lower"]) / 2 == pytest.approx(2.5763 * np.sqrt(more * (1 - more) / 10_000), rel=0.5)
    shown = format_reductions({"lumpy": found})
    assert "of at least 90 %: " in shown
    assert f"{measure} " in shown
    stricter = found_by(lumpy(3), "99%", measure=measure).bracket.best
    assert stricter is not None
    assert stricter.triangles > best.triangles
    nothing = found_by(lumpy(3), 0.9, measure=measure, search={"triangles": (4, 20)})
    assert f"(1 - {measure})" in nothing.reason
    # No sample proves that all of the area is matched.
    assert found_by(original, 1 - 1e-6, measure=measure).reason


def test_degrees_are_read_as_they_are_written() -> None:
    assert limits.Limit.parse("8 °", measure="normal_mean") == limits.Limit(8.0, "normal_mean")


def test_an_open_question_is_not_within() -> None:
    reference, mesh = (SurfaceMember("", -1, lumpy(level), {}) for level in (3, 1))
    numbers = sb.proximity(lumpy(1), lumpy(3))
    value, error = numbers["rms"], numbers["rms_error"]
    for limit, held in ((value + 2.7 * error, True), (value + 2.5 * error, False), (value - 2.7 * error, False)):
        trial, kept = limits.tried(reference, mesh, limits.Limit(limit, "rms"), 80.0)
        assert (trial.is_within, kept is not None) == (held, held)
        assert (trial.lower <= limit) == (limit > value)


def test_one_way_area_and_volume() -> None:
    # A disc of n edges has n sin(2π/n) / 2π of the area of the circle; it covers no farther point of its own.
    circle, ends = disc(lumpy(1), 2 * np.pi / 1000), {"edge": (0.02, 1.5)}
    shares = [count / 1000 * np.sin(2 * np.pi / count) / np.sin(2 * np.pi / 1000) for count in range(3, 100)]
    fewest = 3 + next(k for k, share in enumerate(shares) if share >= 1 - 0.01)
    found = found_by(circle, "1 %", measure="area", method=disc, search=ends)
    assert rows(found)[0] in range(fewest, round(1.06 * fewest))
    assert found.bracket.best is not None
    assert found.bracket.best.upper == pytest.approx(1 - shares[rows(found)[0] - 3])
    assert "1 %: area" in format_reductions({"disc": found})
    assert rows(found_by(circle, 1e-5, measure="hausdorff_forward", method=disc, search=ends))[0] < 6
    assert rows(found_by(circle, 1e-2, measure="hausdorff_backward", method=disc, search=ends))[0] in range(23, 26)
    unknown = found_by(circle, "1%", measure="volume")
    assert "no volume is known: 1,000 open edges" in unknown.reason
    assert not unknown.trials
    within = found_by(lumpy(3), "1%", measure="volume")
    assert within.mesh is not None
    assert 0.98 < within.mesh.volume / lumpy(3).volume < 1
    assert rows(within)[0] < 640


def test_lengths_are_converted_into_the_unit_of_the_files() -> None:
    in_mm = found_by(lumpy(scale=30.0), "0.1cm", unit="mm")
    in_m = found_by(lumpy(scale=0.03), "1 mm", unit="m")
    assert rows(in_mm) == pytest.approx(rows(in_m), rel=0.06) == rows(found_by(lumpy(scale=30.0), 1.0))
    with pytest.raises(sb.errors.InputError, match="name it, as unit='mm'"):
        found_by(lumpy(), "0.1 mm")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_a_file_of_any_format_needs_no_output(suffix: str, tmp_path: Path) -> None:
    sb.write_mesh(lumpy(2), tmp_path / f"scan{suffix}")
    found = sb.reduce(tmp_path / f"scan{suffix}", within=0.1)["scan"]
    assert (found.reason, found.mesh is not None) == ("", True)


class EndedError(Exception):
    """What ends a search in the middle."""


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Sizes that are tried, in this order; a negative number at its beginning ends the trial before so many more."""
    done: list[float] = []

    def counted(mesh: Any, member: Any, limit: Any, size: float) -> Any:
        if done and done[0] < 0:
            done[0] += 1
            if done[0] == 0:
                raise EndedError
        done.append(size)
        return limits.tried(mesh, member, limit, size)

    monkeypatch.setattr(module, "tried", counted)
    return done


def test_a_search_goes_on_where_it_was_ended(scan: Path, tmp_path: Path, tried: list[float]) -> None:
    whole = found_by(scan, within=0.05, output=tmp_path / "whole")
    assert sizes(whole) == tried
    count = len(tried)
    for ended in range(1, count + 1):
        tried[:] = [-ended]
        with pytest.raises(EndedError):
            found_by(scan, within=0.05, output=tmp_path / str(ended))
        tried[0] = 0
        found = found_by(scan, within=0.05, output=tmp_path / str(ended))
        # No size is tried twice, and the result is the same to the byte.
        assert tried[1:] == sizes(whole) == sizes(found)
        assert found.bracket.best is not None
        assert (tmp_path / str(ended) / "scan.ply").read_bytes() == Path(whole.path).read_bytes()
    tried.clear()
    assert found_by(scan, within=0.05, output=tmp_path / "whole") == whole
    assert tried == []


def test_what_changed_since_is_tried_again(scan: Path, tmp_path: Path, tried: list[float]) -> None:
    mesh = tmp_path / "part.ply"
    shutil.copy(scan, mesh)
    output = tmp_path / "reduced"
    found = found_by(mesh, within=0.1, output=output)
    assert found.bracket.best is not None
    written = (output / "part.ply").read_bytes()
    # The file of the result alone is made again.
    (output / "part.ply").unlink()
    tried.clear()
    again = found_by(mesh, within=0.1, output=output)
    assert tried == [found.bracket.best.size]
    assert (output / "part.ply").read_bytes() == written
    assert again.bracket.failed == found.bracket.failed
    # Another tolerance, another measure, another remesher, another mesh: all of it.
    for change in (
        {"within": 0.2},
        {"within": 0.2, "measure": "mean"},
        {"within": 0.2, "measure": "rms"},
        {"within": 0.2, "method": disc, "search": {"edge": (0.5, 1.0)}},
    ):
        tried.clear()
        assert found_by(mesh, **change, output=output).trials
        assert len(tried) > 1
    sb.write_mesh(lumpy(2), mesh)
    assert found_by(mesh, within=0.1, output=output).original_triangles == 320
    # A damaged record is none.
    record = output / "part.json"
    for damage in (b"", b"{", record.read_bytes().replace(b'"size"', b'"sise"')):
        record.write_bytes(damage)
        assert "no record says that a search wrote part.ply" in found_by(mesh, within=0.1, output=output).reason
        (output / "part.ply").unlink()
        tried.clear()
        assert found_by(mesh, within=0.1, output=output).bracket.best is not None
        assert len(tried) > 1


def test_no_mesh_of_an_earlier_search_passes_for_one_that_failed(scan: Path, tmp_path: Path) -> None:
    mesh, output = tmp_path / "part.ply", tmp_path / "reduced"
    shutil.copy(scan, mesh)
    for fail in (lambda: None, lambda: mesh.write_bytes(b"broken")):
        assert not found_by(mesh, within=0.1, output=output).reason
        assert (output / "part.ply").exists()
        fail()
        assert found_by(mesh, within=1e-30, output=output).reason
        assert not (output / "part.ply").exists()
    # Nor does one of another format.
    sb.write_mesh(lumpy(2), tmp_path / "part.obj")
    assert found_by(tmp_path / "part.obj", within=0.1, output=output).path.endswith("part.obj")
    sb.write_mesh(lumpy(1), mesh)
    assert found_by(mesh, within=0.1, output=output).path.endswith("part.ply")
    assert {file.name for file in output.iterdir()} == {"part.json", "part.ply"}
    mesh.write_bytes(b"broken")
    assert found_by(mesh, within=0.1, output=output).reason
    # A file that no search has written stays.
    (output / "part.ply").write_text("precious")
    assert found_by(mesh, within=0.1, output=output).reason
    assert (output / "part.ply").read_text() == "precious"


def test_a_tolerance_that_nothing_meets_and_one_that_four_triangles_meet() -> None:
    nothing = found_by(lumpy(2), within=1e-30)
    assert nothing.bracket.best is None
    assert nothing.bracket.failed is not None
    assert (nothing.bracket.failed.size, nothing.mesh) == (320, None)
    assert "nothing is within the tolerance" in nothing.reason
    # The mesh itself is within a larger one, and is not remeshed.
    itself = found_by(lumpy(2), within=1e-9)
    assert itself.mesh is not None
    assert itself.mesh.digest == lumpy(2).digest
    assert any("the original itself" in remark for remark in itself.remarks)
    assert "the original itself" in str(itself)
    # Another mesh of as many triangles is not the original.
    alike = found_by(lumpy(2), 1e-9, method=lambda mesh, edge: mesh, search={"edge": (0.5, 1.0)})
    assert ("another method" in str(alike), "the original itself" in str(alike)) == (True, False)
    least = found_by(lumpy(2), within=5.0)
    assert least.remarks == ()
    assert least.bracket.best is not None
    assert (least.bracket.best.size, least.bracket.failed, len(least.trials)) == (4, None, 1)
    # The library stops at eight.
    assert 4 <= least.bracket.best.triangles <= 8


def fine_disc(original: sb.Mesh, edge: float) -> sb.Mesh:
    if edge > 0.1:
        raise ValueError("too coarse")
    return disc(original, edge)


def test_where_nothing_coarser_was_made_a_smaller_mesh_is_not_ruled_out() -> None:
    found = found_by(disc(lumpy(1), 0.01), within=0.1, method=fine_disc, search={"edge": (0.02, 1.5)})
    assert found.mesh is not None
    assert any("one may hold" in remark for remark in found.remarks)


def test_a_remesher_that_fails_at_a_size() -> None:
    # A ring of n edges is 1 - cos(π/n) within the circle; that of 13 would be the fewest within 0.03.
    original = disc(lumpy(1), 2 * np.pi / 1000)
    found = found_by(original, within=1 - np.cos(np.pi / 12.5), method=disc, search={"edge": (0.02, 1.5)})
    best, failed = found.bracket.best, found.bracket.failed
    assert best is not None
    assert failed is not None
    assert (best.triangles, failed.triangles) == (14, 0)
    assert "thirteen edges are refused" in failed.reason
    # The empty cell has a reason.
    shown = " ".join(format_reductions({"disc": found}, "markdown").split())
    assert f"size {failed.size:g} failed: tests.batch.test_reduce.disc: ValueError: thirteen edges are refused" in shown
    # One that fails at each size says why.
    wrong = found_by(original, within=0.1, method=lambda mesh, edge: edge / 0, search={"edge": (0.1, 1.0)})
    assert "ZeroDivisionError" in wrong.reason


def test_a_program_that_makes_nothing_does_not_pass_with_the_mesh_itself(tmp_path: Path) -> None:
    search = {"triangles": (4, 320)}
    found = found_by(lumpy(2), within=0.1, method=lambda mesh, triangles: 1 / 0, search=search, output=tmp_path)
    assert found.bracket.best is None
    assert "ZeroDivisionError" in found.reason
    assert not [*tmp_path.glob("*.ply")]


def test_results_that_are_not_monotone_are_told() -> None:
    def uneven(mesh: sb.Mesh, edge: float) -> sb.Mesh:
        return disc(mesh, 2.0 if 0.2 < edge < 0.9 else edge)

    original = disc(lumpy(1), 2 * np.pi / 1000)
    found = found_by(original, within=0.1, method=uneven, search={"edge": (0.02, 1.5)})
    assert not found.bracket.is_monotone
    best = found.bracket.best
    assert best is not None
    assert best.upper <= 0.1
    assert "not monotone" in format_reductions({"disc": found})


@pytest.mark.parametrize(
    ("within", "ends", "spread"), [(0.3, None, 0), (0.03, None, 0), (0.03, (10, 500), 0), (0.3, None, 20)]
)
def test_a_remesher_that_makes_the_same_of_each_size_is_told(
    within: float, ends: tuple[int, int] | None, spread: int
) -> None:
    original, rng = lumpy(3), np.random.default_rng(0)
    half = load_mesh(Remesher.parse("decimate").member(SurfaceMember("", -1, original, {}), 600))

    def same(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
        return sb.Mesh(half.vertices, half.triangles[rng.integers(spread + 1) :])

    search = None if ends is None else {"triangles": ends}
    told = found_by(original, within=within, method=same, search=search)
    assert "sizes do not follow triangles" in told.to_row()["note"]
    assert f"{max(one.triangles for one in told.trials if one.size < 1280)} triangles" in told.to_row()["note"]
    assert "sizes do not follow" in str(told)
    assert "sizes do not follow" not in str(found_by(original, within=within))


@pytest.mark.parametrize("was_open", [False, True])
def test_what_a_remesher_broke_is_told(was_open: bool, tmp_path: Path) -> None:
    whole = lumpy(3)
    sb.write_mesh(sb.Mesh(whole.vertices, whole.triangles[was_open:]), tmp_path / "part.ply")

    def torn(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
        made = load_mesh(Remesher.parse("decimate").member(SurfaceMember("", -1, mesh, {}), triangles))
        return sb.Mesh(made.vertices, [*made.triangles[1:-1], made.triangles[-2]])

    for _ in range(2):
        # Also where it goes on from its record.
        found = found_by(tmp_path / "part.ply", within=0.3, method=torn, output=tmp_path / "reduced")
        assert rows(found)[0] < 640
        for told in (str(found), found.to_row()["note"]):
            assert "unlike the original: " in told
            assert "1 duplicate triangle" in told
            # What was so before is no fault of the remesher.
            assert ("open edges" in told) == (not was_open)
    assert found_by(tmp_path / "part.ply", within=0.3).remarks == ()


def test_the_command_ends_well_only_where_it_wrote_a_mesh_that_holds(tmp_path: Path) -> None:
    sb.write_mesh(lumpy(2), tmp_path / "scan.ply")
    words = "reduce", tmp_path / "scan.ply", "--workers", "1", "--output", tmp_path / "reduced", "--within"
    for within, status in (("0.1", 0), ("1e-9", 0), ("1e-30", 3)):
        done = call(*words, within)
        assert (done.returncode, (tmp_path / "reduced" / "scan.ply").exists()) == (status, status == 0)
        told = " ".join(done.stdout.split())
        assert ("that does is the original itself" in told) == (within == "1e-9")
        assert ("triangles of the original itself" in told) == (within == "1e-30")


@pytest.mark.process
def test_a_program_that_is_missing_is_tried_once() -> None:
    found = found_by(lumpy(1), within=0.1, method="no-such-remesher {input} {output} {triangles}")
    assert found.reason.endswith("no-such-remesher is not installed, or not on the PATH")
    assert (found.trials, found.bracket.best) == ((), None)


@pytest.mark.process
def test_the_command_ends_programs_after_a_time(tmp_path: Path) -> None:
    sb.write_mesh(lumpy(1), tmp_path / "scan.ply")
    words = "reduce", tmp_path / "scan.ply", "--workers", "1", "--output", tmp_path / "reduced", "--within", "0.1"
    method = "--with", "sh -c 'sleep 1000 # {input} {output} {triangles}'"
    done = call(*words, *method, "--timeout", "10 ms")
    assert (done.returncode, "ended after 0.01 s, its timeout" in " ".join(done.stdout.split())) == (3, True)
    wrong = call(*words, *method, "--timeout", "soon")
    assert (wrong.returncode, "timeout: must be a number of seconds" in wrong.stderr) == (2, True)


def test_how_far_away_all_others_are_is_told_where_the_original_is_best() -> None:
    def in_metres(mesh: sb.Mesh, triangles: int) -> sb.Mesh:
        return sb.Mesh(1000 * np.asarray(mesh.vertices), mesh.triangles[:triangles])

    (told,) = found_by(lumpy(1), within=0.1, method=in_metres).remarks
    assert "the original itself; of the others, nearest are " in told
    assert " triangles, at least 1" in told


def test_a_mesh_that_cannot_be_reduced_is_told() -> None:
    found = found_by(lumpy(1), within=1e-6)
    assert found.bracket.best is not None
    assert found.bracket.best.triangles == found.original_triangles
    assert "another method" in " ".join(format_reductions({"lumpy": found}).split())


def test_a_cluster_that_cannot_start_is_no_fault_of_a_mesh(threads: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def differing(*arguments: object) -> None:
        raise sb.errors.ClusterError("versions differ")

    monkeypatch.setattr(module, "prepare_workers", differing)
    with pytest.raises(sb.errors.ClusterError, match="versions differ"):
        sb.reduce({name: sb.shapes.icosphere(1) for name in "ab"}, 0.1, client=threads)


def test_several_meshes_on_a_cluster(client: Client, scan: Path, tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    sb.write_mesh(lumpy(2), tmp_path / "more" / "other.obj")
    (tmp_path / "more" / "broken.stl").write_bytes(b"solid")
    seen: list[str] = []

    def reduced() -> dict[str, Reduction]:
        files = [scan, tmp_path / "more" / "*.*"]
        tell: Callable[[Reduction], None] = lambda one: seen.append(one.name)  # noqa: E731
        return sb.reduce(files, 0.1, output=tmp_path / "reduced", client=client, on_progress=tell)

    found = reduced()
    assert sorted(seen) == sorted(found) == ["broken", "other", "scan"]
    assert found["broken"].reason
    assert found["broken"].bracket.best is None
    for name in ("scan", "other"):
        best, failed = found[name].bracket.best, found[name].bracket.failed
        assert best is not None
        assert failed is not None
        assert best.upper <= 0.1 < failed.upper
        assert best.size <= 1.05 * failed.size + 1
        assert len(sb.read_mesh(found[name].path).triangles) == best.triangles
    assert sorted(path.name for path in (tmp_path / "reduced").iterdir()) == [
        *("other.json", "other.obj", "scan.json", "scan.ply")
    ]
    assert reduced() == found


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"within": "110%"}, "below 1"),
        ({"within": 0.0}, "a positive number"),
        ({"within": 1.0, "measure": "rsm"}, "no measure is named 'rsm'; did you mean rms?"),
        ({"within": 1.0, "measure": "normal_max"}, "normal_max cannot be a limit: .*; known are relative, .*, volume"),
        ({"within": 1.0, "measure": "smallest_angle"}, "smallest_angle cannot be a limit"),
        ({"within": 1.0, "measure": "fscore"}, "a fraction of the fscore below 1"),
        ({"within": 1.0, "measure": 3}, "no measure is named '3'; known are"),
        ({"within": "1%", "measure": "rms"}, "rms is a length, .* are for relative, area, volume, fscore, precision"),
        ({"within": "1%", "measure": "area", "order": -2.0}, "area has no order"),
        ({"within": "1 mm", "measure": "area"}, "a fraction of the area below 1, such as 1%, found '1 mm'"),
        ({"within": "1 mm", "measure": "normal_mean"}, "'1 mm' cannot be converted into 'degree'"),
        ({"within": "1%", "order": 0.0}, "order"),
        ({"within": 1, "method": "nothing"}, "no source is named 'nothing'"),
        ({"within": 1, "method": "x {input} {output} {hausd}"}, "{hausd}"),
        ({"within": 1, "method": "x {input} {hausd}", "search": {"hausd": (0.1, 1.0)}}, "no {output}"),
        ({"within": 1, "search": {"triangles": (9, 4)}}, "the smaller one first"),
        ({"within": 1, "search": {"a": (1, 2), "b": (1, 2)}}, "one parameter is searched"),
        ({"within": 1, "search": ("triangles", 4, 9)}, r"as in \{'triangles': \(100, 1000\)\}, found \('triangles'"),
        ({"within": 1, "search": {"triangles": 9}}, r"one parameter is searched, as in .*, found \{'triangles': 9\}"),
        ({"within": 1, "method": 3}, "no source is named 3"),
        ({"within": 1, "precision": 0}, "precision"),
        *(
            ({"within": 1, "workers": wrong}, "workers must be a whole number from 1 to")
            for wrong in (0, -3, 10**30, "two")
        ),
        *(
            ({"within": 1, "search": {"triangles": wrong}}, "triangles cannot be searched between .*: each must be ")
            for wrong in ((-4, 100), (4, 10**30), (4.5, 1e30))
        ),
    ],
)
def test_wrong_parameters_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=message):
        sb.reduce(lumpy(1), **{"workers": 1, **options})


def test_ends_of_a_search_may_be_numbers_of_numpy() -> None:
    numbers, ends = (np.int64(4), np.int32(200)), (4, 200)
    found, same = (found_by(lumpy(2), within=0.1, search={"triangles": one}) for one in (numbers, ends))
    assert sizes(found) == sizes(same)


@pytest.mark.parametrize(("names", "message"), [([], "none"), ([""], "empty"), (["a\nb"], "invisible")])
def test_meshes_by_name_need_names(names: list[str], message: str) -> None:
    with pytest.raises(sb.errors.InputError, match=f"^meshes to reduce need names of their own, found .*{message}"):
        sb.reduce(dict.fromkeys(names, lumpy(1)), 1.0)


@pytest.mark.parametrize("on_cluster", [False, True])
def test_a_broken_mesh_stops_no_other(on_cluster: bool, threads: Client, tmp_path: Path) -> None:
    options: dict[str, Any] = {"client": threads} if on_cluster else {"workers": 1}
    broken = [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]]
    meshes = {"broken": broken, "sound": lumpy(2), "absent": str(tmp_path / "absent.ply")}
    found = sb.reduce({**meshes, "broken": lumpy(2)}, 0.1, output=tmp_path / "reduced", **options)
    assert not found["broken"].reason
    found = sb.reduce(meshes, 0.1, output=tmp_path / "reduced", **options)
    assert list(found) == [*meshes]
    assert rows(found["sound"])[0] < 160
    assert "NaN" in found["broken"].reason
    assert "absent.ply" in found["absent"].reason
    # What was found before, of another mesh of this name, is no result of this one.
    assert {path.name for path in (tmp_path / "reduced").glob("*.ply")} == {"sound.ply"}
    assert "NaN" in found_by(broken, within=0.1).reason
    with pytest.raises(sb.errors.InputError, match=r"^none: .*found int"):
        sb.reduce({**meshes, "none": 3}, 0.1, **options)


def test_no_original_is_replaced(scan: Path) -> None:
    before = scan.read_bytes()
    with pytest.raises(sb.errors.InputError, match="would replace it"):
        found_by(scan, within=0.1, output=scan.parent)
    assert scan.read_bytes() == before


def test_no_file_is_replaced_that_no_search_wrote(scan: Path, tmp_path: Path) -> None:
    other = tmp_path / scan.name
    other.write_bytes(b"of somebody else")
    found = found_by(scan, within=0.1, output=tmp_path)
    assert "no record says that a search wrote scan.ply" in found.reason
    assert not found.trials
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"of somebody else"]
    other.unlink()
    assert found_by(scan, within=0.1, output=tmp_path).path
    # Neither where a record tells of another file of this name, nor while the search goes on.
    other.write_bytes(b"of somebody else")
    assert "no record says that a search wrote scan.ply" in found_by(scan, within=0.1, output=tmp_path).reason

    def slow(mesh: sb.Mesh, edge: float) -> sb.Mesh:
        other.write_bytes(b"of somebody else")
        return disc(mesh, edge)

    other.unlink()
    found = found_by(scan, within=1e9, method=slow, search={"edge": (0.02, 1.5)}, output=tmp_path)
    assert "no record says that a search wrote scan.ply" in found.reason
    assert other.read_bytes() == b"of somebody else"


def test_a_search_that_ended_before_it_replaced_its_mesh_goes_on(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Location.write

    def ended(location: Location, values: Mapping[str, bytes]) -> None:
        if scan.name in values and (tmp_path / scan.name).exists():
            raise KeyboardInterrupt
        write(location, values)

    monkeypatch.setattr(Location, "write", ended)
    with pytest.raises(KeyboardInterrupt):
        found_by(scan, within=0.1, output=tmp_path)
    monkeypatch.undo()
    assert found_by(scan, within=0.1, output=tmp_path).path


@pytest.mark.process
def test_the_command_goes_on_after_it_was_killed(tmp_path: Path) -> None:
    (tmp_path / "rings.py").write_text(f"{SCRIPT}\nassert sys.argv[1][-4:] == sys.argv[2][-4:] == '.off'")
    sb.write_mesh(disc(lumpy(1), 2 * np.pi / 500), tmp_path / "flat.ply")
    (tmp_path / "broken.ply").write_text("ply")
    files = [str(tmp_path / name) for name in ("flat.ply", "broken.ply")]
    method = ["--with", RINGS.replace("{folder}", str(tmp_path)), "--search", "edge=0.05:1.5", "--suffix", ".off"]
    words = [
        "reduce",
        *files,
        "--within",
        "0.3mm",
        "--unit",
        "cm",
        *method,
        "--workers",
        "1",
        "--output",
        str(tmp_path / "reduced"),
    ]
    record = tmp_path / "reduced" / "flat.json"
    with started(*words) as process:
        while not (record.exists() and len(json.loads(record.read_bytes())["trials"]) >= 2):
            assert process.poll() is None, process.communicate()
        os.kill(process.pid, 9)
    before = json.loads(record.read_bytes())["trials"]
    done = call(*words, "--format", "json")
    assert done.returncode == 3
    assert json.loads(record.read_bytes())["trials"][: len(before)] == before
    broken, flat = sorted(json.loads(done.stdout), key=lambda row: str(row["object"]))
    assert (flat["object"], flat["original_triangles"], flat["measure"]) == ("flat", 500, "hausdorff")
    assert "failed: " in flat["note"]
    assert "thirteen edges are refused" in flat["note"]
    # 1 - cos(π/n) is at most 0.03 from n = 13 on, which the remesher refuses.
    assert (flat["triangles"], flat["failed_triangles"]) == (14, 0)
    assert flat["upper"] <= 0.03
    assert (broken["triangles"], broken["trials"]) == (None, 0)
    assert "broken.ply" in broken["note"]
    shown = call(*words)
    assert shown.returncode == 3
    assert "fewest triangles within 0.03 cm" in shown.stdout
    assert "flat: 14 of 500 triangles" in shown.stderr
    assert call("reduce", *files, "--within", "1", "--output", "x", "--search", "edge").returncode == 2
