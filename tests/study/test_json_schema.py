"""The JSON schema accepts study files and refuses what no study file may have."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sobolev_batch.cli.program import cli

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
WORKFLOWS = sorted((Path(__file__).parents[2] / "workflows").glob("*.toml"))
# Those with fits are valid where the extras are.
FILES = [pytest.param(path, marks=[pytest.mark.extras] * path.stem.endswith("fitted")) for path in WORKFLOWS]


@pytest.fixture(scope="module")
def validator() -> Any:
    shown = CliRunner().invoke(cli, ["schema"])
    assert shown.exit_code == 0
    schema = json.loads(shown.stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in WORKFLOWS])
def test_study_files_are_valid(path: Path, validator: Any) -> None:
    assert list(validator.iter_errors(tomllib.loads(path.read_text("utf-8")))) == []


STUDY: dict[str, Any] = {
    "study": {"name": "balls"},
    "accuracy": {"rtol": 0.01},
    "reference": {"source": "icosphere", "levels": [3]},
    "family": [
        {"name": "levels", "source": "icosphere", "levels": [1, 2]},
        {"name": "few", "source": "decimate", "within": ["1 %"], "order_by": "names"},
    ],
}


@pytest.mark.parametrize(
    ("section", "change"),
    [
        ("accuracy", {"rtol": "much"}),
        ("accuracy", {"rtols": 0.01}),
        ("reference", {"source": "icosfere", "levels": [3]}),
        ("family", [{"name": "levels", "source": "icosphere", "level": 1}]),
        ("family", [{"source": "icosphere", "levels": [1]}]),
        ("norms", {"orders": [-2.0]}),
    ],
)
def test_mistakes_are_not(section: str, change: Any, validator: Any) -> None:
    assert list(validator.iter_errors(STUDY)) == []
    assert list(validator.iter_errors({**STUDY, section: change}))
