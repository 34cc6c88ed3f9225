"""What the package finds by its name: entry points of other packages, and its own extras where they are installed.

Nothing below the extras imports them, so that the rest works without their folder. A table says instead what they add
to the groups that other packages extend too: sources of surfaces, formats of files, and commands.
"""

from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any

from sobolev_batch.errors import InputError

# Groups of entry points; "features" are parts of commands and functions of the core, which no other package replaces.
SOURCES, FORMATS, COMMANDS = "sobolev_batch.sources", "sobolev_batch.formats", "sobolev_batch.commands"
FEATURES = "sobolev_batch.features"

_EXTRAS = "sobolev_batch.extras"
_OF_EXTRAS = {
    SOURCES: {"fit": "fitting.families:FitSource", "refine": "fitting.families:RefineSource"},
    FORMATS: {
        name: f"formats.{name}:FORMATS" for name in ("gltf", "gifti", "freesurfer", "vtk", "printing", "remeshing")
    },
    COMMANDS: {
        "export": "commands:export_command",
        "fit": "commands:fit_command",
        "init": "commands:init_command",
        "plot": "commands:plot_command",
        "report": "commands:report_command",
        "table league": "commands:league_command",
        "table time": "commands:time_command",
        "witness": "commands:witness_command",
    },
    FEATURES: {
        "align": "fitting.align:align",
        "picture": "figures.views:write_difference_picture",
        "comparison": "report.comparison_page:comparison_page",
    },
}


def registered(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group: those of the extras, if these are installed, before those of other packages.

    >>> [point.value for point in registered(SOURCES) if point.name == "refine"]
    ['sobolev_batch.extras.fitting.families:RefineSource']
    """
    own = [_point(group, name) for name in _OF_EXTRAS[group]] if find_spec(_EXTRAS) else []
    return (*own, *entry_points(group=group))


def is_extra(group: str, name: str) -> bool:
    """Return whether the extras add this name to a group, whether or not they are installed."""
    return name in _OF_EXTRAS[group]


def extra(group: str, name: str, purpose: str) -> Any:
    """Load what the extras add to a group under a name; InputError, with the purpose, where they are not installed."""
    if find_spec(_EXTRAS) is None:
        raise InputError(f"{purpose} needs {_point(group, name).module}, and {_EXTRAS} is not installed")
    return _point(group, name).load()


def _point(group: str, name: str) -> EntryPoint:
    return EntryPoint(name, f"{_EXTRAS}.{_OF_EXTRAS[group][name]}", group)
