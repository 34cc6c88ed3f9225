"""Whatever is required, directly or not, may be used with programs under any licence. This is the only list of them."""

from __future__ import annotations

import re
from importlib.metadata import distribution

import pytest
from packaging.requirements import Requirement

# Of libigl, whose changed files alone would have to be published.
PER_FILE = {"libigl": "MPL 2.0"}
COPYLEFT = re.compile(r"GPL|Affero|GNU|MPL|Mozilla|EPL|Eclipse|EUPL|CDDL|copyleft|SSPL|share.?alike", re.IGNORECASE)
PERMISSIVE = re.compile(r"\b(0?BSD\b|MIT|ISC|Apache|PSF|Python Software Foundation|Zlib|CC0)", re.IGNORECASE)


def licence_of(name: str) -> str:
    """Return what a distribution says of its licence, by any of the ways in which packages do."""
    about = distribution(name).metadata
    fields = [about.get_all(field, []) for field in ("License-Expression", "Classifier", "License")]
    said = [text for texts in fields for text in texts if texts is not fields[1] or text.startswith("License ::")]
    return said[0].partition("\n")[0] if said else ""


def required_by(name: str) -> set[str]:
    """Return a distribution, in small letters, and all that it requires without an extra."""
    found, waiting = set[str](), [name]
    while waiting:
        one = waiting.pop().lower().replace("_", "-")
        if one not in found:
            found.add(one)
            needs = map(Requirement, distribution(one).requires or ())
            waiting += [need.name for need in needs if need.marker is None or need.marker.evaluate({"extra": ""})]
    return found


def is_free_of_copyleft(name: str, licence: str) -> bool:
    rest = licence.replace(PER_FILE.get(name, "?"), "MIT").replace("Mozilla Public License", "")
    return bool(PERMISSIVE.search(rest)) and not COPYLEFT.search(rest if name in PER_FILE else licence)


def test_nothing_required_is_copyleft() -> None:
    licences = {name: licence_of(name) for name in required_by("sobolev-batch")}
    assert {"numpy", "tornado", "libigl"} <= licences.keys()
    assert {name: text for name, text in licences.items() if not is_free_of_copyleft(name, text)} == {}


@pytest.mark.parametrize(
    ("name", "licence", "is_free"),
    [
        ("numpy", "BSD-3-Clause AND 0BSD AND MIT", True),
        ("numpy", "BSD-3-Clause AND GPL-3.0-or-later WITH GCC-exception-3.1", False),
        ("other", "License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)", False),
        ("other", "License :: OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)", False),
        ("other", "", False),
    ],
)
def test_copyleft_would_be_found(name: str, licence: str, is_free: bool) -> None:
    assert is_free_of_copyleft(name, licence) is is_free
