"""What `plan`, `run` and `submit` settle first: the place of the store, and permissions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sobolev_batch.errors import InputError, StoreError, StudyError
from sobolev_batch.parameters import as_names, check_flags
from sobolev_batch.sources.mesh_cache import MeshCache
from sobolev_batch.sources.names import known_names, quoted
from sobolev_batch.store.location import Location
from sobolev_batch.study.study import Study, StudyLike, as_study

# A store as functions take it, None for the default place.
StoreLike = str | Path | Location | None

_DEFAULT_FOLDER = Path("storage")
# Folder beside a store for the meshes that its study makes, and commands that a refusal lists.
MADE_MESHES, _MOST_COMMANDS = "made-meshes", 3


def settled(study: StudyLike, store: StoreLike, *, may_run: bool, may_search: bool) -> tuple[Study, Location]:
    """Return a study that keeps the meshes that it makes beside its store, and the place of the store.

    Stores there share the meshes. The place is storage/NAME.zarr where none is named.
    """
    check_flags(allow_commands=may_run)
    study = as_study(study)
    location = Location.parse(_DEFAULT_FOLDER / f"{study.name}.zarr" if store is None else store)
    return study.with_cache(MeshCache(location.absolute().beside(MADE_MESHES), may_run, may_search)), location


def ready_to_run(
    study: StudyLike, store: StoreLike, *, allow_commands: bool, only: Sequence[str] = ()
) -> tuple[Study, Location]:
    """Return a study that may run, or a part of it, and its place."""
    check_flags(allow_commands=allow_commands)
    part = replace(as_study(study), only=tuple(as_names(only)))
    study, location = settled(part, store, may_run=True, may_search=True)
    require_permission(study, allow_commands)
    _require_members(study, study.only)
    if store is None:
        with location.access("written"):
            _DEFAULT_FOLDER.mkdir(exist_ok=True)
    if problem := location.lacks_folder():
        raise StoreError(problem)
    return study, location


def require_permission(study: Study, allow_commands: bool) -> None:
    """Refuse a study that runs commands and may not, by a StudyError."""
    if study.commands and not allow_commands:
        raise StudyError(
            f"the study runs commands: {', '.join(study.commands[:_MOST_COMMANDS])}; if you trust it, allow them by "
            "--allow-commands (in Python: allow_commands=True)"
        )


def _require_members(study: Study, only: Sequence[str]) -> None:
    known, unknown = dict[str, None](), list(only)
    for one in study.objects.values() if only else ():
        try:
            families = (family for family, _ in one.members.values())
            known |= dict.fromkeys([*filter(None, [one.name]), *families, *one.members])
        except InputError:
            return  # The run reports what cannot be listed, and may have any name.
        unknown = [name for name in unknown if not one.chosen([name])]
    for name in unknown:
        raise StudyError(f"no object, family or member of the study is {quoted(name)}; {known_names(name, known)}")
