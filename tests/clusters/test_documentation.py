"""The commands of docs/clusters.md and the manifest kubernetes.yaml exist and fit together."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from dask.utils import parse_bytes
from distributed.cli import dask_scheduler, dask_worker

from sobolev_batch import Study
from sobolev_batch.cli import cli
from tests.support.recipes import FOLDER, documented
from tests.support.repository import ROOT

COMMANDS: dict[tuple[str, ...], click.Command] = {("sobolev-batch", name): made for name, made in cli.commands.items()}
COMMANDS |= {("dask", "scheduler"): dask_scheduler.main, ("dask", "worker"): dask_worker.main}
# One binary and one decimal unit, as Kubernetes writes them.
UNITS = {"Gi": "GiB", "Mi": "MiB"}


def check_options(words: list[str]) -> None:
    """Check that a command has each of the options, and that values follow those that take one."""
    command = COMMANDS[words[0], words[1]]
    takes_value = {
        name: not option.is_flag
        for option in command.params
        if isinstance(option, click.Option)
        for name in (*option.opts, *option.secondary_opts)
    }
    for word, following in zip(words, [*words[1:], "--end"], strict=True):
        if word.startswith("--"):
            assert word in takes_value, f"{words[:2]} has no {word}"
            assert takes_value[word] != (following.startswith("--")), f"{word} {following}"


CLUSTER, GPU, TO_SCHEDULER, TO_WORKERS, STUDY, JOB = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
PODS: dict[str, dict[str, Any]] = {
    "worker": CLUSTER["spec"]["worker"]["spec"],
    "scheduler": CLUSTER["spec"]["scheduler"]["spec"],
    "gpu": GPU["spec"]["worker"]["spec"],
    "submit": JOB["spec"]["template"]["spec"],
}


def test_documented_options_exist() -> None:
    commands = [words for words in documented() if tuple(words[:2]) in COMMANDS]
    assert len(commands) == 7
    for words in commands:
        check_options(words)
    for words in documented("python "):
        assert (ROOT / words[1]).is_file()
    # Not imported, since that changes the effect of Ctrl-C.
    assert importlib.util.find_spec("dask_jobqueue") is not None


@pytest.mark.parametrize("name", PODS)
def test_pods(name: str) -> None:
    pod = PODS[name]
    (container,) = pod["containers"]
    check_options(container["args"])
    assert pod["automountServiceAccountToken"] is False
    assert pod["securityContext"]["runAsNonRoot"] is True
    security = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
    assert container["securityContext"] == security
    volumes = {volume["name"] for volume in pod["volumes"]}
    assert {mount["name"] for mount in container["volumeMounts"]} == volumes
    resources = container["resources"]
    assert resources["requests"] == resources["limits"]
    if "--memory-limit" in container["args"]:
        limit = container["args"][container["args"].index("--memory-limit") + 1]
        allowed = resources["limits"]["memory"]
        # The nanny beside the worker takes some memory too.
        assert parse_bytes(limit) <= 0.85 * parse_bytes(allowed[:-2] + UNITS[allowed[-2:]])
    if name != "scheduler":
        assert container["envFrom"] == [{"secretRef": {"name": "object-store"}}]


def test_the_parts_of_the_manifest_name_each_other() -> None:
    name = CLUSTER["metadata"]["name"]
    assert GPU["spec"]["cluster"] == name
    selector = {"dask.org/cluster-name": name, "dask.org/component": "scheduler"}
    assert CLUSTER["spec"]["scheduler"]["service"]["selector"] == selector
    assert TO_SCHEDULER["spec"]["podSelector"]["matchLabels"] == selector
    ports = [{"protocol": "TCP", "port": port} for port in (8786, 8787)]
    # From this namespace, and from this cluster.
    assert TO_SCHEDULER["spec"]["ingress"] == [{"from": [{"podSelector": {}}], "ports": ports}]
    assert TO_WORKERS["spec"]["podSelector"]["matchLabels"] == {**selector, "dask.org/component": "worker"}
    own = {"podSelector": {"matchLabels": {"dask.org/cluster-name": name}}}
    assert TO_WORKERS["spec"]["ingress"] == [{"from": [own]}]
    (container,) = PODS["submit"]["containers"]
    assert f"tcp://{name}-scheduler:8786" in container["args"]
    assert "--trust-network" in container["args"]
    (secret,) = (words for words in documented("kubectl") if "secret" in words)
    assert container["envFrom"][0]["secretRef"]["name"] == secret[secret.index("generic") + 1]
    assert STUDY["metadata"]["name"] in str(JOB)


def test_the_study_of_the_manifest_is_valid(tmp_path: Path) -> None:
    ((name, text),) = STUDY["data"].items()
    (tmp_path / name).write_text(text)
    assert Study.from_toml(tmp_path / name).name == "icosphere"
    assert f"/study/{name}" in PODS["submit"]["containers"][0]["args"]


def test_the_image() -> None:
    lines = (FOLDER / "Dockerfile").read_text().splitlines()
    (build,) = documented("docker build")
    assert build[build.index("--tag") + 1] == PODS["worker"]["containers"][0]["image"]
    copied = [line for line in lines if line.startswith("COPY ") and "--from" not in line]
    sources = [word for line in copied for word in line.split()[1:-1]]
    assert {"pyproject.toml", "sobolev_batch"} <= set(sources)
    assert all((ROOT / source).exists() for source in sources)
    user = str(PODS["worker"]["securityContext"]["runAsUser"])
    assert f"USER {user}:{user}" in lines
