"""The option --below of compare: a verdict as exit status, for test suites in any language."""

from __future__ import annotations

from pathlib import Path

import click
from click.core import ParameterSource

from sobolev_batch.cli.group import EXIT_DIFFERENT, EXIT_UNDECIDED
from sobolev_batch.cli.options import fraction_of_norm
from sobolev_batch.cli.output import echo
from sobolev_batch.testing import DEFAULT_ORDER

_STATUSES = {"same": 0, "different": EXIT_DIFFERENT, "undecided": EXIT_UNDECIDED}
# Options of compare that a verdict knows; it chooses the accuracy of the distance itself.
_KNOWN = {"a", "b", "below", "orders", "memory", "no_scaling"}

below_option = click.option(
    "--below",
    type=fraction_of_norm,
    metavar="FRACTION",
    help="Tell whether the distance is below FRACTION of the norm of B, such as 1e-3 or 0.1%, by the exit status. "
    f"[default order: {DEFAULT_ORDER:g}]",
)


def judge_files(context: click.Context, a: Path, b: Path, below: float) -> int:
    """Print one line on whether two files hold the same surface, and return the exit status.

    Raises:
        click.UsageError: Other options ask for numbers, or there are several orders.
    """
    from sobolev_batch.testing.verdict import same_surface

    given = {
        parameter.opts[0]
        for parameter in context.command.params
        if context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE
        and parameter.name not in _KNOWN
    }
    if given:
        raise click.UsageError(f"--below gives a verdict and no numbers; leave out {', '.join(sorted(given))}")
    if not 0 < below < 1:
        raise click.UsageError(f"--below takes a fraction between 0 and 1, or 0 and 100 %, found {below:g}")
    orders = context.params["orders"] or (DEFAULT_ORDER,)
    if len(orders) > 1:
        raise click.UsageError("--below takes one --order")
    (order,) = orders
    settings = {"scaling": not context.params["no_scaling"], "memory": context.params["memory"]}
    verdict = same_surface(a, b, rtol=below, order=order, **settings)
    echo(f"{a.name}: {verdict}")
    return _STATUSES[verdict.outcome]
