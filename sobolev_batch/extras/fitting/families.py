"""The sources `fit` and `refine`: meshes of another source, brought nearer to the reference of a study."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from sobolev_batch.errors import InputError, MeshError, StudyError
from sobolev_batch.extras.fitting import DEFAULT_SMOOTHING, DEFAULT_STEPS
from sobolev_batch.extras.fitting.fit import MOST_TRIANGLES, fitted_mesh, largest_while_refining
from sobolev_batch.extras.fitting.objective import MOST_SMOOTHING, MOST_STEPS, FitSettings
from sobolev_batch.geometry.mesh import Mesh
from sobolev_batch.geometry.surface import Similarity, Surface
from sobolev_batch.norms import DEFAULT_ORDER
from sobolev_batch.sources.registry import (
    ExpectedSize,
    Fingerprint,
    Member,
    NestedSource,
    OtherSource,
    Several,
    Source,
    installed_version,
    load_mesh,
    single_member,
)

# Raise it whenever a fit of the same mesh gives another one.
_VERSION = 3
# Usual processor time of a step, and for each triangle of it.
_STEP_SECONDS, _STEP_TRIANGLE_SECONDS = 0.01, 4e-5
# Measured peak of a fit: its lattice, and for each triangle of the mesh and of the target.
_LATTICE_BYTES, _TRIANGLE_BYTES, _TARGET_BYTES = 3e8, 2e3, 400.0
# The last fits of this process, by the fingerprints of their members.
_KEPT = 8
_fits: dict[str, Mesh] = {}


class FitSource(NestedSource):
    """Meshes of another source, each with its vertices moved nearer to a surface: see `fit`, also for the settings.

    Distances are those in the unit ball of the target, as in a study that is scaled by its reference.

    Attributes:
        mesh: Table of the source of the meshes to start from.
        target: Table of a source with one surface; the study's reference if left out.
    """

    mesh: OtherSource
    target: OtherSource | None = None
    order: Annotated[float, Field(lt=-0.5, ge=-100.0)] = DEFAULT_ORDER
    steps: Annotated[int, Field(ge=1, le=MOST_STEPS)] = DEFAULT_STEPS
    smoothing: Annotated[float, Field(ge=0.0, le=MOST_SMOOTHING)] = DEFAULT_SMOOTHING
    keep_boundary: bool = False

    def with_reference(self, reference: Source) -> Source:
        """Return the source with the study's reference as its target, unless it has one of its own."""
        target = reference if self.target is None else self.target.with_reference(reference)
        return self.model_copy(update={"mesh": self.mesh.with_reference(reference), "target": target})

    @property
    def settings(self) -> FitSettings:
        """Settings of fits."""
        return FitSettings(self.order, self.steps, self.smoothing, self.keep_boundary)

    def target_member(self, folder: Path) -> Member:
        """Return the member of the target; StudyError where there is none, or several."""
        if self.target is None:
            example = 'target = { source = "files", paths = ["a.ply"] }'
            raise StudyError(f"there is nothing to fit to: a reference and its family need a target, such as {example}")
        return single_member(self.target, folder)

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member for each mesh to start from."""
        target, settings = self.target_member(folder), self.settings
        return tuple(
            FittedMember(one.name, one.level, one, target, settings, time=one.time, metadata=one.metadata)
            for one in self.mesh.members(folder)
        )


class RefineSource(FitSource):
    """Finer versions of one mesh, with edges split where that brings it nearer to a surface: see `refine`."""

    triangles: Several[Annotated[int, Field(ge=1, le=MOST_TRIANGLES)]]

    def members(self, folder: Path) -> tuple[Member, ...]:
        """Return one member per triangle count, coarse to fine."""
        target, start = self.target_member(folder), single_member(self.mesh, folder)
        return tuple(
            FittedMember(str(count), rank, start, target, self.settings, count)
            for rank, count in enumerate(sorted(set(self.triangles)))
        )


@dataclass(frozen=True)
class FittedMember(Member):
    """A mesh with its vertices moved towards a target, and refined if a number of triangles is given."""

    start: Member
    target: Member
    settings: FitSettings
    triangles: int | None = None

    @property
    def names_wishes(self) -> bool:
        """As those of the mesh that it begins with, whose metadata it has."""
        return self.start.names_wishes

    def load(self) -> Surface:
        """Return the fitted mesh, that of an earlier call in this process if there is one; MeshError where it fails."""
        digest = self.fingerprint_digest()
        fitted = _fits.get(digest) or self._fit()
        # A file of it may have been changed meanwhile.
        if self.fingerprint_digest() == digest:
            _fits[digest] = fitted
        for old in [*_fits][:-_KEPT]:
            _fits.pop(old, None)
        return fitted

    def _fit(self) -> Mesh:
        start, target = load_mesh(self.start), self.target.load()
        similarity = Similarity.to_unit_ball(target)
        try:
            fitted = fitted_mesh(similarity.apply(start), similarity.apply(target), self.settings, self.triangles)
        except InputError as error:
            raise MeshError(f"{self.start.name} cannot be fitted to {self.target.name}: {error}") from error
        vertices = np.asarray(fitted.vertices) / similarity.scale + np.asarray(similarity.origin)
        return Mesh(vertices, fitted.triangles)

    def fingerprint(self) -> Fingerprint:
        """Return the fingerprints of both members, the settings, and the versions of the libraries."""
        return {
            "fit": dict(self.start.fingerprint()),
            "target": dict(self.target.fingerprint()),
            "settings": asdict(self.settings),
            "version": _VERSION,
            **({} if self.triangles is None else {"triangles": self.triangles}),
            **{library: installed_version(library) for library in ("finufft", "scipy")},
        }

    def expected_size(self) -> ExpectedSize:
        """Return the size of the mesh, and the memory that the fit takes."""
        start, target = self.start.expected_size(), self.target.expected_size()
        count = self.triangles or start.triangles
        largest = count if self.triangles is None else largest_while_refining(start.triangles, count)
        own_bytes = _LATTICE_BYTES + _TRIANGLE_BYTES * largest + _TARGET_BYTES * target.triangles
        step_seconds = _STEP_SECONDS + _STEP_TRIANGLE_SECONDS * count
        return ExpectedSize(
            count,
            max(start.projected_bytes, target.projected_bytes, own_bytes),
            start.seconds + target.seconds + step_seconds * self.settings.steps,
            start.is_known or self.triangles is not None,
        )
