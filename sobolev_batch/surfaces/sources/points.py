"""The source `points`: point clouds from the file system, by path or glob."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from sobolev_batch.surfaces.formats.readers import mesh_format
from sobolev_batch.surfaces.point_files import expected_bytes, expected_points, read_points
from sobolev_batch.surfaces.shapes.surface import Surface
from sobolev_batch.surfaces.sources.files import matching_files, names_of_files
from sobolev_batch.surfaces.sources.fingerprints import file_digest
from sobolev_batch.surfaces.sources.mesh_lists import MOST_MESHES
from sobolev_batch.surfaces.sources.registry import ExpectedSize, Fingerprint, Member, Source, at_most


class PointSource(Source):
    """Files of points with their areas: PLY, or text of one line for each point.

    Attributes:
        paths: Paths or globs; see `FileSource`.
        weight: Area of each point: the name of a vertex property of PLY files, or of a column of text files, or the
            number of a column, counted from 1.
        area: Total area of the points of a file, in place of ``weight``; all its points stand for the same.
    """

    paths: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1, strict=False), at_most(MOST_MESHES)
    ]
    weight: Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)] | None = None
    area: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _has_areas(self) -> Self:
        if self.weight is not None and self.area is not None:
            raise ValueError('both "weight" and "area" are given; give one of them')
        if self.weight is None and self.area is None:
            raise ValueError(
                'give the area of each point by "weight", the name or number of a property or column, or by "area" '
                "the total area of points that all stand for the same"
            )
        return self

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per file, sorted by path, and named by the file's stem where that is unique."""
        paths = sorted({match for path in self.paths for match in matching_files(folder, path)})
        names = zip(paths, names_of_files(paths), strict=True)
        return tuple(PointMember(name, -1, path.absolute(), self.weight, self.area) for path, name in names)


@dataclass(frozen=True)
class PointMember(Member):
    """A file of points."""

    path: Path
    weight: str | int | None
    area: float | None
    is_quickly_loaded: ClassVar[bool] = True

    @property
    def is_point_cloud(self) -> bool:
        """True: the file is read as points."""
        return True

    def load(self) -> Surface:
        """Read the file."""
        return read_points(self.path, weight=self.weight, area=self.area)

    def fingerprint(self) -> Fingerprint:
        """Return the format, the digest of the file, and where areas come from."""
        return {
            "points": file_digest(self.path),
            "format": mesh_format(self.path),
            "weight": self.weight,
            "area": self.area,
        }

    def expected_size(self) -> ExpectedSize:
        """Return the memory and the number of points that the length of the file suggests."""
        return ExpectedSize(0, expected_bytes(self.path), points=expected_points(self.path))
