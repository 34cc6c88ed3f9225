"""Files of pictures: formats, sizes and reproducible bytes."""

from __future__ import annotations

import struct
from pathlib import Path

import matplotlib as mpl
import pytest
import xarray as xr

import sobolev_batch as sb
from sobolev_batch.results.figures.pictures import Output, parse_size
from sobolev_batch.results.figures.plots import write_plots


@pytest.mark.all
def test_vector_formats_keep_text_and_no_dates(tree: xr.DataTree, tmp_path: Path) -> None:
    settings = dict(mpl.rcParams)
    written = [
        write_plots(tree, tmp_path / folder, output=Output(("pdf", "svg", "png"))).paths for folder in ("a", "b")
    ]
    assert [path.name for path in written[0]][:3] == ["convergence.pdf", "convergence.svg", "convergence.png"]
    for one, other in zip(*written, strict=True):
        assert one.read_bytes() == other.read_bytes(), one
    pdf, svg, _ = (path.read_bytes() for path in written[0][:3])
    # A TrueType font in full, which journals ask for, and no outlines in its place.
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    assert b"CreationDate" not in pdf
    assert b"<text" in svg
    assert b"relative Sobolev distance" in svg
    assert b"<dc:date>" not in svg
    assert dict(mpl.rcParams) == settings


@pytest.mark.slow
def test_the_size_is_that_of_a_panel(tree: xr.DataTree, tmp_path: Path) -> None:
    output = Output(("png",), parse_size("3x2in"))
    (path, *_) = write_plots(tree, tmp_path, output=output).paths
    # The header of a PNG: two panels of 300 dots per inch.
    assert struct.unpack(">II", path.read_bytes()[16:24]) == (900, 1200)


@pytest.mark.parametrize("text", ["8.4x6cm", "84x60mm", "84 × 60 mm"])
def test_sizes_in_other_units(text: str) -> None:
    assert parse_size(text) == pytest.approx((8.4 / 2.54, 6 / 2.54))


@pytest.mark.parametrize("text", ["6", "6x", "6x4m", "axb", "1.2.3x4", "100x100", "0x4", "5x5mm"])
def test_wrong_sizes(text: str) -> None:
    with pytest.raises(sb.InputError, match=r"size|inches"):
        parse_size(text)
