"""Octaves: the partition, random lattices, drawn frequencies, and the sums over them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from sobolev_batch import Lattice, Mesh
from sobolev_batch.geometry.subdivision import subdivided
from sobolev_batch.geometry.surface import Surface
from sobolev_batch.norms.distances import distance
from sobolev_batch.norms.spectrum import RadialAxis
from sobolev_batch.norms.tail import remainder as remainder_module
from sobolev_batch.norms.tail.face_normals import FaceNormals
from sobolev_batch.norms.tail.integrals import OctaveSums, OctaveWeights, integral_over, squared_moduli
from sobolev_batch.norms.tail.remainder import remainder_between, remainder_of_flat
from sobolev_batch.norms.tail.sampling import Octave, OctaveSampling, TailSampling
from sobolev_batch.norms.tail.values import OctaveValues, SurfaceSize, octave_values
from sobolev_batch.shapes import Sphere, Torus, icosphere
from sobolev_batch.transform.exact import exact_transform
from sobolev_batch.transform.fourier import ON_CPU, ErrorTarget, TransformSettings
from sobolev_batch.transform.lattice import OctaveLattice, smooth_step
from sobolev_batch.transform.spheres import sphere_transform
from tests.support.oracles import torus_value
from tests.support.rectangles import Rectangles

OCTAVE = Octave(2.0, 1)
ORDERS = (-1.0, -2.0)
BOX = Rectangles.box((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2)).mesh()
TARGET = ErrorTarget(ORDERS, (1e-4, 1e-4))


def sampling_of(surface: Surface, seed: int, intervals: int = 16, draws: int = 200) -> OctaveSampling:
    sizes, rng = [intervals] if intervals else [], np.random.default_rng(seed)
    normals = FaceNormals.from_surfaces([surface])
    found = OctaveSampling(OCTAVE, (), draws, 0, normals, 0.3).redrawn(OCTAVE, sizes, draws, rng)
    return replace(found, seed=seed)


def values_of(surface: Surface, sampling: OctaveSampling, known: OctaveValues | None = None) -> OctaveValues:
    return octave_values(surface, sampling, ORDERS, TARGET, ON_CPU, known=known)


def sums_of(surface: Surface, sampling: OctaveSampling) -> OctaveSums:
    return OctaveWeights(sampling, ORDERS).sums(squared_moduli(values_of(surface, sampling).values))


def sphere_integral(order: float, radius: float = 1.0) -> float:
    """∫ window (1+r²)^s |σ^|² over an octave, for a sphere."""

    def integrand(r: float) -> float:
        value = 2 * radius * np.sin(2 * np.pi * radius * r) / r
        return float(OCTAVE.window(np.array(r)) * (1 + r * r) ** order * value**2 * 4 * np.pi * r * r)

    return float(quad(integrand, OCTAVE.lowest, OCTAVE.highest, limit=200)[0])


def test_the_ball_and_its_octaves_are_a_partition_of_one() -> None:
    radii = np.linspace(0, 60, 2001)
    octaves = [Octave(5.0, index) for index in range(1, 5)]
    total = smooth_step(radii, 5.0) + sum(octave.window(radii) for octave in octaves)
    assert total == pytest.approx(smooth_step(radii, octaves[-1].highest), abs=1e-15)
    assert (total[radii <= 40] == 1).all()
    for octave in octaves:
        assert not octave.window(radii[(radii <= octave.lowest) | (radii >= octave.highest)]).any()


@pytest.mark.parametrize("surface", [icosphere(2), Sphere(0.8, (0.1, 0.2, -0.4)), Torus(0.8, 0.3), BOX])
def test_values_on_a_random_lattice_are_those_at_its_frequencies(surface: Surface) -> None:
    sampling = sampling_of(surface, 3)
    values = values_of(surface, sampling)
    chosen = np.random.default_rng(0).integers(sampling.sample_sets[0].samples.stop, size=20)
    frequencies = sampling.frequencies[chosen]
    if isinstance(surface, Mesh):
        expected = exact_transform(surface, frequencies)
    elif isinstance(surface, Sphere):
        expected = sphere_transform(surface, frequencies)
    else:
        expected = np.array([torus_value(0.8, 0.3, float(np.hypot(x, y)), float(z)) + 0j for x, y, z in frequencies])
    assert np.abs(values.values[chosen] - expected).max() < 1e-4 * surface.area
    assert (values.error_norms(ORDERS) <= 10 * np.array(TARGET.norms)).all()


@pytest.mark.parametrize(("intervals", "draws"), [(8, 0), (12, 0), (0, 400), (8, 300)])
def test_sums_over_an_octave_are_right_within_their_standard_errors(intervals: int, draws: int) -> None:
    # The lattice is far too coarse for the sphere: every image overlaps the next.
    expected = np.array([sphere_integral(order) for order in ORDERS])
    found = [sums_of(Sphere(), sampling_of(Sphere(), seed, intervals, draws)) for seed in range(60)]
    misses = np.array([sums.squares - expected for sums in found])
    # Without a random shift, or with wrong weights, the mean would be off by many standard errors of a mean.
    assert (np.abs(misses.mean(axis=0)) < 4 / np.sqrt(60) * misses.std(axis=0)).all()
    assert np.mean(np.abs(misses) < 3 * np.sqrt([sums.variances for sums in found])) > 0.95


@pytest.mark.parametrize("stored", [False, True])
def test_errors_of_a_lattice_hold_where_images_touch_a_ball_that_no_sublattice_shows(stored: bool) -> None:
    # Six images one period away meet the ball at once, whatever the rotation.
    ball, missed = Sphere(3.05), 0
    expected = np.array([sphere_integral(order, ball.radius) for order in ORDERS])
    for seed in range(25):
        sampling = sampling_of(ball, seed, 48, 0)
        squares = squared_moduli(sphere_transform(ball, sampling.frequencies))
        if stored:
            axis = RadialAxis(Lattice(2.0, 8), TailSampling(OCTAVE.cutoff, (sampling,)))
            spectra = axis.spectra(np.zeros((1, axis.lattice.shell_count)), squares[None])
            values, errors = (found[:, 0] for found in axis.octave_integrals(spectra, ORDERS))
        else:
            values, errors = integral_over([OctaveWeights(sampling, ORDERS).sums(squares)])
        missed += bool(np.any(np.abs(values - expected) > errors))
        assert (errors < 0.08 * expected).all()
    assert missed <= 1


def test_draws_follow_their_density() -> None:
    assert FaceNormals.from_surfaces([icosphere(0)])
    # Curved surfaces have none.
    assert not FaceNormals.from_surfaces([icosphere(4), Sphere()])
    normals = FaceNormals.from_surfaces([BOX])
    assert len(normals.shares) == 3
    assert normals.shares.sum() == pytest.approx(1)
    rng = np.random.default_rng(0)
    uniform = rng.normal(size=(200_000, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    radii = np.full(len(uniform), 4.0)
    density = 4 * np.pi * normals.density(uniform, radii)
    assert density.mean() == pytest.approx(1, rel=0.02)
    drawn = normals.draw(radii, rng)
    assert np.linalg.norm(drawn, axis=1) == pytest.approx(1)
    for powers in ((2, 0, 0), (0, 0, 8), (0, 2, 2)):
        moment = np.prod(drawn**powers, axis=1).mean()
        assert moment == pytest.approx((np.prod(uniform**powers, axis=1) * density).mean(), rel=0.03)


def test_draws_around_normals_make_flat_faces_quick_to_sample() -> None:
    octave = Octave(40.0, 1)
    deviations = []
    for normals in (FaceNormals.from_surfaces([BOX]), FaceNormals.from_surfaces([Sphere()])):
        sums = sums_of(BOX, OctaveSampling(octave, (), 2000, 0, normals, 0.3))
        deviations.append(sums.energy_deviation / sums.energy)
    assert deviations[0] < 0.1
    assert deviations[1] > 3 * deviations[0]


def test_spots_that_are_narrower_than_the_rounding_of_cosines_are_met() -> None:
    octave, turn = Octave(1e9, 1), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    surface = Mesh(BOX.vertices @ turn, BOX.triangles)
    normals = FaceNormals.from_surfaces([surface])
    sums = sums_of(surface, OctaveSampling(octave, (), 4000, 0, normals, 0.3))
    assert abs(sums.energy - 2 * surface.area) < 3 * sums.energy_deviation < 0.4 * surface.area


def test_known_values_are_not_computed_again() -> None:
    sampling = sampling_of(BOX, 0)
    known = values_of(BOX, sampling)
    more = replace(sampling, lattices=(*sampling.lattices, *sampling_of(BOX, 1).lattices))
    # What is known is taken as it is, wrong or right.
    marked = replace(known, values=known.values + 1)
    found, fresh = values_of(BOX, more, marked), values_of(BOX, more)
    (lattice, drawn), (first, second, last) = sampling.sample_sets, more.sample_sets
    assert (found.values[first.samples] == marked.values[lattice.samples]).all()
    assert (found.values[last.samples] == marked.values[drawn.samples]).all()
    assert found.values[second.samples] == pytest.approx(fresh.values[second.samples], abs=1e-12)
    assert len(found.radii) == 2 * len(known.radii)
    other_draws = replace(sampling, seed=7)
    again = values_of(BOX, other_draws, marked)
    assert again.values[drawn.samples] == pytest.approx(values_of(BOX, other_draws).values[drawn.samples], abs=1e-12)


def test_statistical_errors_grow_with_few_degrees_of_freedom() -> None:
    few, many = (sums_of(BOX, sampling) for sampling in (sampling_of(BOX, 0, 16, 0), sampling_of(BOX, 0, 0, 2000)))
    assert (integral_over([few])[1] / np.sqrt(few.variances) > 3.4).all()
    assert (integral_over([many])[1] / np.sqrt(many.variances) < 2.7).all()
    # Eight sublattices that carry the variance have no more degrees of freedom for many draws beside them.
    mixed = replace(
        few,
        variances_by_origin=few.variances_by_origin[0] * np.array([[1.0], [1e-6]]),
        degrees=np.array([few.degrees[0], 2000]),
    )
    assert (integral_over([mixed])[1] / np.sqrt(mixed.variances) > 3.4).all()


def test_one_sample_that_carries_the_sum_may_stand_for_others() -> None:
    squares = np.zeros(400)
    squares[7] = 1.0
    weights = OctaveWeights(sampling_of(BOX, 0, 0, 400), ORDERS)
    sums = weights.sums(squares)
    assert (sums.variances >= 1.9 * (weights.by_order[:-1] @ squares) ** 2).all()


def test_wrong_values_have_large_errors() -> None:
    values = values_of(icosphere(2), sampling_of(icosphere(2), 0))
    off = values_of(icosphere(2), values.sampling, replace(values, values=values.values + 0.1))
    window = OCTAVE.highest - OCTAVE.lowest
    for order, norm in zip(ORDERS, off.error_norms(ORDERS), strict=True):
        radii = np.linspace(OCTAVE.lowest, OCTAVE.highest, 1001)
        square = np.mean(OCTAVE.window(radii) * (1 + radii**2) ** order * 0.01 * 4 * np.pi * radii**2) * window
        assert 0.8 * np.sqrt(square) < norm < 4 * np.sqrt(square)


def sizes_of(sampling: TailSampling) -> list[int]:
    return [lattice.M for one in sampling.octaves for lattice in one.lattices]


def test_joined_samplings_serve_the_most_demanding_pilot_in_each_octave() -> None:
    first, second = TailSampling.usual(4.0, 2, [BOX]), TailSampling.usual(4.0, 3, [BOX], seed=1)
    large = [replace(one, lattices=tuple(replace(lattice, M=96) for lattice in one.lattices)) for one in first.octaves]
    fewer, fewest = ([replace(one, draws=n) for one in it.octaves] for it, n in ((first, 900), (second, 700)))
    normals = FaceNormals.from_surfaces([BOX])
    joined = TailSampling.joined(4.0, [large, fewest, fewer], normals)
    assert sizes_of(joined) == [96, 96, 64]
    assert [one.draws for one in joined.octaves] == [20_000, 20_000, 700]
    assert [one.draws for one in TailSampling.joined(4.0, [fewer, fewest], normals).octaves] == [900, 900, 700]


def test_refined_samplings_have_more_samples_within_the_largest_lattice() -> None:
    usual = TailSampling.usual(4.0, 2, [BOX])
    refined = usual.refined(8.0, 1, 1000, seed=3)
    assert sizes_of(refined) == [128, 128, 128]
    assert [one.draws for one in refined.octaves] == [160_000] * 3
    assert refined.octaves[-1].octave.highest == 2 * usual.highest_frequency
    assert sizes_of(usual.refined(8.0, 0, 70, seed=3)) == [70, 70]
    # A lattice that is larger already stays.
    assert sizes_of(usual.refined(8.0, 0, 38, seed=3)) == [64, 64]


def test_samples_follow_from_the_seed_differ_in_each_octave_and_survive_storage() -> None:
    first, again, other = (TailSampling.usual(4.0, 2, [BOX], seed=seed) for seed in (0, 0, 1))
    stored = TailSampling.from_dict(json.loads(json.dumps(first.to_dict())))
    assert stored.digest == first.digest == again.digest != other.digest
    for same in (again, stored):
        assert np.array_equal(same.frequencies, first.frequencies)
        for one, other_one in zip(same.octaves, first.octaves, strict=True):
            assert np.array_equal(one.weights, other_one.weights)
    offsets = [one.lattices[0].offset for one in first.octaves]
    assert offsets[0] != offsets[1]


def square_of_strips(count: int) -> Mesh:
    y = np.arange(count + 1) / count
    vertices = np.stack([np.repeat([0.0, 1.0], count + 1), np.tile(y, 2), np.zeros(2 * count + 2)], axis=1)
    i = np.arange(count)
    across, beyond = i + 1 + count, i + 2 + count
    return Mesh(vertices, np.concatenate([np.stack([i, across, beyond], 1), np.stack([i, beyond, i + 1], 1)]))


def test_the_cheaper_way_to_an_octave_of_long_triangles_goes_by_their_area() -> None:
    lattice = OctaveLattice.random(40.0, 160.0, 64, np.random.default_rng(0))
    whole, strips = square_of_strips(1), square_of_strips(100)
    points = [TransformSettings(1e-3).kind_for(square, lattice).expected_points for square in (whole, strips)]
    assert points[1] < 4 * points[0]
    assert not SurfaceSize.from_surface(whole).prefers_exact(lattice)
    assert not SurfaceSize.from_surface(strips).prefers_exact(lattice)


@pytest.mark.parametrize("times", [0, 3])
def test_strips_that_repeat_beyond_a_given_lattice_are_off_by_about_their_error(times: int) -> None:
    # Half a pitch of 1/16 apart, they hardly differ below |ξ| = 16.
    a, b = (Rectangles.strips(16, offset, 1.0, 0.5) for offset in (0.0, 0.5))
    one, other, orders = a.mesh(), b.mesh(), (-0.75, -1.0)
    for _ in range(times):
        one, other = subdivided(one), subdivided(other)
    found = distance(one, other, orders, lattice=Lattice(3.0, 24))
    ratios = found["error"] / (np.sqrt(a.squared_distance(b, orders)[0]) - found["distance"])
    assert (ratios > 1).all()
    assert (ratios < 1.2).all()


def test_large_meshes_are_not_looked_at_beyond_a_given_lattice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remainder_module, "_MOST_FLAT", 11)
    monkeypatch.delattr(remainder_module, "without_common_parts")
    assert remainder_of_flat((BOX, BOX), 2.0) is None
    assert np.isfinite(distance(BOX, Sphere(), -2.0, lattice=Lattice(2.0, 24))["error"])


def test_bounds_beyond_a_cutoff_hold_at_any_order() -> None:
    orders, cutoff, radii = np.array([-0.55, -0.7, -1.7, -3.5, -15.0, -60.0]), 2.0, np.linspace(2.0, 400.0, 400_001)
    bounds = remainder_between((Sphere(), Sphere(0.9)), cutoff).bounds(orders.tolist())
    energies = 4 * np.pi * (4 * np.pi * radii * (np.sinc(2 * radii) - 0.81 * np.sinc(1.8 * radii))) ** 2
    # Farther out both sines average out.
    far = 8 * np.pi * (1 + 0.81) * radii[-1] ** (2 * orders + 1) / (-2 * orders - 1)
    true = np.array([np.trapezoid((1 + radii**2) ** order * energies, radii) for order in orders]) + far
    assert (bounds > true).all()
    assert (bounds[:4] < [1.2, 1.2, 2.0, 8.0] * true[:4]).all()
