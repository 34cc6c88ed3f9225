"""What distances say in words."""

from __future__ import annotations

import math
from collections.abc import Mapping

import xarray as xr

from sobolev_batch.results.tables.formatting import Digits, bound, count_text, second_digit

# Surfaces whose distance, relative to the reference, is certainly smaller differ by rounding.
_ROUNDING = 1e-10
# A share of area is told if its error is no larger, and to whole per cents.
_LARGEST_SHARE_ERROR, _WHOLE_PERCENT = 0.1, 0.01
# Area is called lost or gained if the surface really lost or gained at least this fraction of what fits best.
_LEAST_CHANGE = 0.5


def answer(name: str, reference: str, result: xr.Dataset | Mapping[str, float], area_change: float) -> str:
    """Return a sentence that says how much a surface differs from the reference at one order.

    Args:
        name: Name of the surface.
        reference: Name of the reference.
        result: Variables of `distance` at one order, and the order.
        area_change: Area of the surface over that of the reference, minus one.

    >>> numbers = {"distance": 0.3, "error": 0.003, "relative": 0.0102, "relative_error": 0.0001}
    >>> shares = {"area_share": 0.561, "area_share_error": 0.02, "excess": -0.007}
    >>> answer("small.obj", "large.obj", {"order": -2.0, **numbers, **shares}, area_change=-0.008)
    'small.obj differs from large.obj by 1.02 % ± 0.01 % at order -2; 56 % of it is lost area.'
    >>> answer("small.obj", "large.obj", {"order": -2.0, **numbers, **shares, "distance": 1e-3}, area_change=-0.008)
    'small.obj differs from large.obj by less than 1.1 % at order -2: not resolved.'
    """
    numbers = {key: float(result[key]) for key in ("distance", "error", "relative", "relative_error")}
    at_order = f"at order {float(result['order']):g}"
    if numbers["distance"] == numbers["error"] == 0:
        return f"{name} and {reference} are identical: they have the same triangles."
    if numbers["distance"] > numbers["error"]:
        amount = Digits.percent(numbers["relative"], numbers["relative_error"]).together
        return f"{name} differs from {reference} by {amount} {at_order}{_share_text(result, area_change)}."
    most = numbers["relative"] + numbers["relative_error"]
    if most < _ROUNDING:
        return f"{name} and {reference} are equal up to rounding {at_order}: they differ by less than {bound(most)}."
    amount = "an unknown amount" if math.isnan(most) else f"less than {bound(most)}"
    return f"{name} differs from {reference} by {amount} {at_order}: not resolved."


def likeness(name: str, reference: str, result: xr.Dataset | Mapping[str, float]) -> str:
    """Return a sentence that says which changes of the reference bring it as far from itself as a surface is.

    Args:
        name: Name of the surface.
        reference: Name of the reference.
        result: Variables of `yardsticks` at one order, and the order.

    >>> amounts = {"order": -2.0, "moved": 0.0081, "noise": 0.0032, "decimated": 2312.0}
    >>> errors = {"moved_error": 1e-4, "noise_error": 1e-4, "decimated_error": 40.0}
    >>> print(likeness("small.obj", "large.obj", {**amounts, **errors}))
    At order -2, small.obj is as far from large.obj as
      large.obj moved by 0.81 % of its radius,
      large.obj with noise of 0.32 % of its radius,
      large.obj decimated to 2,300 triangles.
    """
    found = {kind: float(result[kind]) for kind in ("moved", "noise", "decimated")}
    errors = {kind: max(float(result[f"{kind}_error"]), second_digit(amount)) for kind, amount in found.items()}
    texts = {
        "moved": f"moved by {Digits.percent(found['moved'], errors['moved']).value} of its radius",
        "noise": f"with noise of {Digits.percent(found['noise'], errors['noise']).value} of its radius",
        "decimated": f"decimated to {count_text(found['decimated'], errors['decimated'])} triangles",
    }
    known = [f"  {reference} {text}" for kind, text in texts.items() if not math.isnan(found[kind])]
    at_order = f"At order {float(result['order']):g}, "
    if not known:
        return f"{at_order}no move, noise or decimation of {reference} is known to be as far from it."
    return f"{at_order}{name} is as far from {reference} as\n" + ",\n".join(known) + "."


def _share_text(result: xr.Dataset | Mapping[str, float], area_change: float) -> str:
    """Return which share of a squared distance is a change of area; nothing where that is not known."""
    share, error, excess = (float(result[key]) for key in ("area_share", "area_share_error", "excess"))
    if not error <= _LARGEST_SHARE_ERROR:
        return ""
    if share + error < _WHOLE_PERCENT:
        return "; less than 1 % of it is a change of area"
    # A moved surface has lost no area, though a smaller multiple of the reference fits it best.
    if share <= error or not area_change / excess >= _LEAST_CHANGE:
        return ""
    amount = Digits.percent(share, max(error, _WHOLE_PERCENT)).value
    return f"; {amount} of it is {'lost' if excess < 0 else 'gained'} area"
