"""Samplings of all octaves of a study: joined from those of pilots, and refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sobolev_batch import icosphere
from sobolev_batch.spectral.octaves.normals import FaceNormals
from sobolev_batch.spectral.octaves.sampling import OctaveSampling
from sobolev_batch.spectral.octaves.tail_sampling import TailSampling
from tests.support.rectangles import Rectangles

BOX = Rectangles.box((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2)).mesh()


def with_draws(sampling: TailSampling, count: int) -> list[OctaveSampling]:
    return [replace(one, drawn=replace(one.drawn, count=count)) for one in sampling.octaves]


def test_joined_samplings_serve_the_most_demanding_pilot_in_each_octave() -> None:
    first, second = TailSampling.usual(4.0, 2, [BOX]), TailSampling.usual(4.0, 3, [BOX], seed=1)
    large = [replace(one, lattices=tuple(replace(lattice, M=96) for lattice in one.lattices)) for one in first.octaves]
    joined = TailSampling.joined(
        4.0, [large, with_draws(second, 700), with_draws(first, 900)], FaceNormals.from_surfaces([BOX])
    )
    assert [[lattice.M for lattice in one.lattices] for one in joined.octaves] == [[96], [96], [64]]
    assert [len(one.drawn) for one in joined.octaves] == [20_000, 20_000, 700]
    joined = TailSampling.joined(
        4.0, [with_draws(first, 900), with_draws(second, 700)], FaceNormals.from_surfaces([BOX])
    )
    assert [len(one.drawn) for one in joined.octaves] == [900, 900, 700]


def test_refined_samplings_have_more_samples_within_the_largest_lattice() -> None:
    usual = TailSampling.usual(4.0, 2, [BOX])
    refined = usual.refined(8.0, 1, 1000, seed=3)
    assert [[lattice.M for lattice in one.lattices] for one in refined.octaves] == [[128], [128], [128]]
    assert [len(one.drawn) for one in refined.octaves] == [160_000] * 3
    assert refined.octaves[-1].octave.highest == 2 * usual.highest_frequency
    assert [[lattice.M for lattice in one.lattices] for one in usual.refined(8.0, 0, 70, seed=3).octaves] == [
        [70],
        [70],
    ]
    # A lattice that is larger already stays.
    assert usual.refined(8.0, 0, 38, seed=3).octaves[0].lattices[0].M == 64


def test_samples_follow_from_the_seed_and_differ_in_each_octave() -> None:
    first, again, other = (TailSampling.usual(4.0, 2, [icosphere(2)], seed=seed) for seed in (0, 0, 1))
    assert first.digest == again.digest != other.digest
    assert np.array_equal(first.frequencies, again.frequencies)
    offsets = [one.lattices[0].offset for one in first.octaves]
    assert offsets[0] != offsets[1]
