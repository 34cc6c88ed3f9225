"""Recipes of clusters: jobs of SLURM and PBS, several machines by hand, the manifest of Kubernetes, and their page."""

from __future__ import annotations

import importlib.util
import re
import shutil
import socket
import ssl
import stat
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
import dask
import psutil
import pytest
import yaml
from dask.utils import parse_bytes
from distributed import Client
from distributed.cli import dask_scheduler, dask_worker

from sobolev_batch import Study, open_store
from sobolev_batch.batch.cluster.clients import check_connection, remote_client
from sobolev_batch.cli import cli
from sobolev_batch.errors import ClusterError
from tests.support.commands import COMMAND, finished
from tests.support.processes import PATIENCE_SECONDS, listening, scheduler_address, stop
from tests.support.recipes import (
    CERTIFICATES,
    FOLDER,
    RESULT,
    add_command,
    documented,
    environment,
    run_recipe,
    write_study,
)
from tests.support.repository import ROOT
from tests.support.stores import contents

SETTINGS = FOLDER / "jobqueue.yaml"

# Stand-ins for the commands of SLURM: every job runs at once on this machine.
SBATCH = """
if [ -n "$REFUSE" ]; then echo "sbatch: error: Invalid account" >&2; exit 1; fi
cp "$1" "$HOME/job-$$"
setsid bash "$HOME/job-$$" > "$HOME/log-$$" 2>&1 < /dev/null &
echo "Submitted batch job $!"
"""
SCANCEL = 'kill -- "-$1"'


def jobqueue(
    home: Path, *options: str, settings: Path = SETTINGS, **variables: str
) -> subprocess.CompletedProcess[str]:
    command = documented("python workflows/clusters/jobqueue.py")[-1][1:3]
    script, study = FOLDER / Path(command[0]).name, command[1]
    return run_recipe(home, sys.executable, script, study, *options, DASK_CONFIG=str(settings), **variables)


@pytest.mark.process
@pytest.mark.parametrize(
    ("system", "directives"),
    [
        ("slurm", ["-p compute", "-A project42", "--cpus-per-task=8", "--mem=32G", "-t 04:00:00"]),
        pytest.param(
            *("pbs", ["-q compute", "-A project42", "-l select=1:ncpus=8:mem=32GB", "-l walltime=04:00:00"]),
            marks=pytest.mark.all,
        ),
    ],
)
def test_the_script_of_a_job(system: str, directives: list[str], tmp_path: Path) -> None:
    completed = jobqueue(tmp_path, "--system", system, "--print-script")
    assert completed.returncode == 0, completed.stderr
    lines = completed.stdout.splitlines()
    for directive in directives:
        assert f"#{'SBATCH' if system == 'slurm' else 'PBS'} {directive}" in lines
    (worker,) = (line for line in lines if "dask_worker" in line)
    assert worker.startswith(f"{sys.executable} -m distributed.cli.dask_worker tls://")
    for option in (
        *("--nthreads 1", "--nworkers 8", "--memory-limit 4.00GiB", "--nanny", "--interface ib0", "--tls-key "),
        *("--lifetime 225m", "--lifetime-stagger 10m", "--dashboard-address 127.0.0.1:0"),
    ):
        assert f" {option}" in worker
    assert "--lifetime-restart" not in worker


@pytest.mark.parametrize("system", ["slurm", "pbs"])
def test_lifetimes_end_before_the_walltime(system: str) -> None:
    settings = yaml.safe_load(SETTINGS.read_text())["jobqueue"][system]
    options = dict(zip(settings["worker-extra-args"][::2], settings["worker-extra-args"][1::2], strict=True))
    longest = sum(int(options[name].removesuffix("m")) for name in ("--lifetime", "--lifetime-stagger"))
    hours, minutes, _ = map(int, settings["walltime"].split(":"))
    assert longest + 3 < 60 * hours + minutes
    assert settings["cores"] == settings["processes"]


@pytest.mark.all
def test_objects_and_commands_on_local_jobs_with_the_exit_status_of_run(tmp_path: Path) -> None:
    write_study(tmp_path)
    text = (tmp_path / "study.toml").read_text().replace('[reference]\nsource = "sphere"', "")
    made = '[[family]]\nname = "made"\nsource = "command"\nmesh = { source = "icosphere", levels = [1] }\n'
    balls = "".join(f'[[object]]\nname = "{name}"\nreference = {{ source = "sphere" }}\n' for name in "ab")
    made += 'command = ["false", "{input}", "{output}"]\n'
    (tmp_path / "study.toml").write_text(text + made + balls)
    options = ["--system", "local", "--allow-commands", "--store", "results.zarr"]
    completed = jobqueue(tmp_path, *options)
    assert completed.returncode == 3, completed.stderr
    assert "12 computed, 0 reused, 2 failed" in completed.stdout


@pytest.mark.all
def test_a_study_on_local_jobs(tmp_path: Path) -> None:
    write_study(tmp_path)
    completed = jobqueue(tmp_path, "--system", "local", "--jobs", "1", "--adaptive", "--store", "results.zarr")
    assert completed.returncode == 0, completed.stderr
    assert re.search(RESULT, completed.stdout)
    assert completed.stderr.count(": complete") == 6
    assert (tmp_path / "results.zarr" / "zarr.json").exists()
    assert not list(tmp_path.glob(".sobolev-batch*"))


@pytest.fixture
def slurm(tmp_path: Path) -> Path:
    """Return a home with SLURM's commands and settings for two workers a job."""
    add_command(tmp_path, "sbatch", SBATCH)
    add_command(tmp_path, "scancel", SCANCEL)
    settings = yaml.safe_load(SETTINGS.read_text())
    change = {"cores": 2, "processes": 2, "memory": "2GiB", "local-directory": str(tmp_path), "interface": None}
    settings["jobqueue"]["slurm"].update(change)
    settings["jobqueue"]["slurm"]["scheduler-options"]["host"] = "127.0.0.1"
    settings["jobqueue"]["slurm"]["worker-extra-args"] += ["--host", "127.0.0.1"]
    (tmp_path / "jobqueue.yaml").write_text(yaml.safe_dump(settings))
    return tmp_path


REPLACED = """
import jobqueue
from distributed import Client
from tests.support.processes import wait_until

if __name__ == "__main__":
    jobqueue.INTERVAL_SECONDS = 0.2
    with jobqueue.jobs_of("slurm", 1) as cluster, Client(cluster) as client:
        client.wait_for_workers(2, timeout=200)
        first = set(client.scheduler_info(n_workers=-1)["workers"])
        assert all(worker.startswith("tls://127.0.0.1") for worker in first)
        wait_until(lambda: all(getattr(job, "had_workers", False) for job in cluster.workers.values()))
        client.retire_workers(list(first))
        client.wait_for_workers(2, timeout=200)
        assert not first & set(client.scheduler_info(n_workers=-1)["workers"])
"""


@pytest.mark.all
def test_a_job_whose_workers_have_left_is_replaced(slurm: Path) -> None:
    completed = run_recipe(slurm, sys.executable, "-c", REPLACED, DASK_CONFIG=str(slurm / "jobqueue.yaml"))
    assert completed.returncode == 0, completed.stderr
    assert len(list(slurm.glob("job-*"))) == 2
    assert not list(slurm.glob(".sobolev-batch*"))


@pytest.mark.all
def test_a_job_that_is_refused(slurm: Path) -> None:
    write_study(slurm)
    completed = jobqueue(slurm, "--system", "slurm", settings=slurm / "jobqueue.yaml", REFUSE="yes")
    assert completed.returncode == 1
    assert "sbatch: error: Invalid account" in completed.stderr
    assert "Traceback" not in completed.stderr
    assert not list(slurm.glob(".sobolev-batch*"))


@pytest.mark.all
def test_settings_that_cannot_serve(tmp_path: Path) -> None:
    completed = jobqueue(tmp_path, "--system", "slurm", settings=tmp_path / "nothing.yaml")
    assert completed.returncode == 1
    assert "jobqueue.slurm.cores is not set: copy jobqueue.yaml" in completed.stderr
    completed = jobqueue(tmp_path, "--system", "slurm", PATH=str(tmp_path))
    assert "sbatch is not on the PATH" in completed.stderr
    everywhere = tmp_path / "everywhere.yaml"
    everywhere.write_text(SETTINGS.read_text().replace("    interface: ib0", "    interface: null"))
    completed = jobqueue(tmp_path, "--system", "pbs", "--print-script", settings=everywhere)
    assert "jobqueue.pbs.interface is not set, and the scheduler would listen on all networks" in completed.stderr


# Options first, then the command, once per task.
SRUN = """
while [[ $1 == -* ]]; do shift; done
trap 'kill $(jobs -p)' TERM
for _ in $(seq "$SLURM_NTASKS"); do "$@" 2>> "$HOME/workers.log" & done
wait
wait
"""


@pytest.mark.all
def test_a_study_in_one_allocation(tmp_path: Path) -> None:
    add_command(tmp_path, "srun", SRUN)
    write_study(tmp_path)
    script, study = documented("sbatch workflows")[0][1:]
    loopback = next(name for name, found in psutil.net_if_addrs().items() if found[0].address == "127.0.0.1")
    variables = {"INTERFACE": loopback, "RECIPES": str(FOLDER), "SLURM_SUBMIT_DIR": str(tmp_path)}
    variables |= {"SLURM_NTASKS": "1", "SLURM_MEM_PER_CPU": "2048"}
    recipe = FOLDER / Path(script).name
    completed = run_recipe(tmp_path, "bash", recipe, study, "--store", "results.zarr", **variables)
    assert completed.returncode == 0, completed.stderr
    assert re.search(RESULT, completed.stdout)
    log = (tmp_path / "workers.log").read_text()
    for line in (r"Start worker at: +tls://127\.0\.0\.1", r"Memory: +2\.00 GiB", "End worker"):
        assert len(re.findall(line, log)) == 1
    assert not list(tmp_path.glob(".sobolev-batch.*"))


def test_its_directives_come_before_its_commands() -> None:
    lines = (FOLDER / "slurm.sbatch").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    directives = [i for i, line in enumerate(lines) if line.startswith("#SBATCH ")]
    assert 0 < max(directives) < first


COMMANDS: dict[tuple[str, ...], click.Command] = {("sobolev-batch", name): made for name, made in cli.commands.items()}
COMMANDS |= {("dask", "scheduler"): dask_scheduler.main, ("dask", "worker"): dask_worker.main}


def check_options(words: list[str]) -> None:
    """Check that a command has each of the options, and that values follow those that take one."""
    command = COMMANDS[words[0], words[1]]
    options, *_ = command.make_parser(click.Context(command)).parse_args(words[2:])
    assert not any(str(value).startswith("--") for value in options.values()), options


CLUSTER, GPU, TO_SCHEDULER, TO_WORKERS, STUDY, JOB = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
PODS: dict[str, dict[str, Any]] = {
    "worker": CLUSTER["spec"]["worker"]["spec"],
    "scheduler": CLUSTER["spec"]["scheduler"]["spec"],
    "gpu": GPU["spec"]["worker"]["spec"],
    "submit": JOB["spec"]["template"]["spec"],
}


def test_documented_options_exist() -> None:
    commands = [words for words in documented() if tuple(words[:2]) in COMMANDS]
    assert len(commands) == 5
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
        # The nanny beside the worker takes some memory too.
        assert parse_bytes(limit) <= 0.85 * parse_bytes(resources["limits"]["memory"])
    if name != "scheduler":
        assert container["envFrom"] == [{"secretRef": {"name": "object-store"}}]


def test_the_parts_of_the_manifest_name_each_other() -> None:
    name = CLUSTER["metadata"]["name"]
    assert GPU["spec"]["cluster"] == name
    selector = {"dask.org/cluster-name": name, "dask.org/component": "scheduler"}
    assert CLUSTER["spec"]["scheduler"]["service"]["selector"] == selector
    own = {"podSelector": {"matchLabels": {"dask.org/cluster-name": name}}}
    ports = [{"protocol": "TCP", "port": port} for port in (8786, 8787)]
    # From this namespace, and from this cluster.
    for policy, component, rule in (
        (TO_SCHEDULER, "scheduler", {"from": [{"podSelector": {}}], "ports": ports}),
        (TO_WORKERS, "worker", {"from": [own]}),
    ):
        matched = policy["spec"]["podSelector"]["matchLabels"]
        assert matched == {"dask.org/cluster-name": name, "dask.org/component": component}
        assert policy["spec"]["ingress"] == [rule]
    (container,) = PODS["submit"]["containers"]
    assert {f"tcp://{name}-scheduler:8786", "--trust-network"} <= set(container["args"])
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


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def certificates(home: Path) -> Path:
    made = finished(CERTIFICATES, home / "dask-tls")
    assert made.returncode == 0, made.stderr
    assert f"export DASK_CONFIG={home}/dask-tls/tls.yaml" in made.stdout
    return home / "dask-tls"


@pytest.fixture(scope="module")
def others(home: Path) -> Path:
    assert finished(CERTIFICATES, home / "others", "2").returncode == 0
    return home / "others"


def configured(folder: Path | None) -> Any:
    """Set Dask's configuration as if DASK_CONFIG named the tls.yaml of a folder."""
    settings = yaml.safe_load((folder / "tls.yaml").read_text()) if folder else {}
    return dask.config.set(dask.config.merge(dask.config.config, settings))


Cluster = tuple[str, list[subprocess.Popen[str]]]


@pytest.fixture(scope="module")
def cluster(home: Path, certificates: Path) -> Iterator[Cluster]:
    """Yield a scheduler and two workers, started as documented but on loopback and free ports."""
    ((_, export),) = documented("export DASK_CONFIG=~/dask-tls")
    variable, value = export.replace("~", str(home)).split("=")
    (scheduler,), (worker,) = documented("dask scheduler"), documented("dask worker")
    changes = {"8786": "0", "127.0.0.1:8787": "127.0.0.1:0", "--interface": "--host", "eth0": "127.0.0.1", "-1": "2"}

    def start(words: list[str], stderr: Any) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", words[0], *(changes.get(word, word) for word in words[1:])]
        process = subprocess.Popen(command, env=environment(home, **{variable: value}), stderr=stderr, text=True)
        stack.callback(stop, process)
        return process

    with ExitStack() as stack:
        log = stack.enter_context((home / "worker.log").open("w"))
        first = start(scheduler, subprocess.PIPE)
        changes["tls://HOST:8786"] = address = scheduler_address(first)
        second = start(worker, log)
        with configured(certificates), Client(address) as client:
            client.wait_for_workers(2, timeout=PATIENCE_SECONDS)
        yield address, [first, second]


@pytest.mark.all
def test_certificates_are_for_their_owner_and_stay(certificates: Path, home: Path) -> None:
    files = sorted(certificates.iterdir())
    assert [file.name for file in files] == ["ca.pem", "certificate.pem", "key.pem", "tls.yaml"]
    assert stat.S_IMODE(certificates.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    assert finished("openssl", "verify", "-x509_strict", "-CAfile", *files[:2]).returncode == 0
    before = contents(certificates)
    again = finished(CERTIFICATES, certificates)
    assert again.returncode == 2
    assert f"{certificates} already exists" in again.stderr
    assert contents(certificates) == before
    assert not list(home.glob(".make-certificates*"))


@pytest.mark.all
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "call it as: make-certificates FOLDER"),
        (["new", "soon"], "DAYS is soon"),
        (["nowhere/new"], "the folder nowhere for new does not exist"),
        (['n"ew'], 'contains one of " '),
    ],
)
def test_certificates_are_not_made(arguments: list[str], message: str, tmp_path: Path) -> None:
    completed = finished(CERTIFICATES, *arguments, cwd=tmp_path)
    assert completed.returncode == 2
    assert message in completed.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.all
def test_a_study_over_tls(cluster: Cluster, certificates: Path, home: Path, tmp_path: Path) -> None:
    write_study(tmp_path)
    (address, processes), (run,) = cluster, documented("sobolev-batch run")
    words = [address if word == "tls://HOST:8786" else word for word in run[1:]]
    variables = {"HOME": str(home), "DASK_CONFIG": str(certificates / "tls.yaml")}
    completed = run_recipe(tmp_path, *COMMAND, *words, **variables)
    assert completed.returncode == 0, completed.stderr
    assert re.search(RESULT, completed.stdout)
    meshes = open_store(tmp_path / "storage" / "small.zarr")["meshes"].to_dataset()
    assert all(worker.startswith("tls://") for worker in meshes["worker"].values.tolist())
    # Nothing listens beyond loopback.
    assert {ip for ip, _ in listening(*(process.pid for process in processes))} == {"127.0.0.1"}


@pytest.mark.all
def test_a_client_without_certificate_is_refused(cluster: Cluster, certificates: Path) -> None:
    context = ssl.create_default_context(cafile=certificates / "ca.pem")
    context.check_hostname = False
    host, port = cluster[0].removeprefix("tls://").split(":")
    with (
        socket.create_connection((host, int(port)), timeout=PATIENCE_SECONDS) as plain,
        context.wrap_socket(plain) as encrypted,
        pytest.raises(ssl.SSLError, match="certificate required"),
    ):
        encrypted.recv(1)


@pytest.mark.all
def test_each_way_to_miss_an_encrypted_scheduler_is_told_in_one_line(
    cluster: Cluster, certificates: Path, others: Path, tmp_path: Path
) -> None:
    def refusal(folder: Path | None, address: str) -> str:
        with configured(folder), pytest.raises(ClusterError) as caught, remote_client(address):
            pass
        assert "\n" not in str(caught.value)
        return str(caught.value)

    plain = cluster[0].replace("tls", "tcp")
    # The right authority, and a certificate that it did not sign.
    shutil.copytree(others, tmp_path, dirs_exist_ok=True)
    shutil.copy(certificates / "ca.pem", tmp_path)
    (tmp_path / "tls.yaml").write_text((others / "tls.yaml").read_text().replace(str(others), str(tmp_path)))
    for folder, address, reason in [
        (None, cluster[0], "TLS expects a `ssl_context`"),
        (None, plain, "closed"),
        (certificates, plain, "encryption required"),
        (others, cluster[0], "certificate verify failed"),
        (tmp_path, cluster[0], "no Dask scheduler answers"),
    ]:
        message = refusal(folder, address)
        for part in (reason, f"no Dask scheduler answers at {address!r}", "its DASK_CONFIG is needed here"):
            assert part.lower() in message.lower()
    (tmp_path / "key.pem").unlink()
    assert "No such file" in refusal(tmp_path, cluster[0])


@pytest.mark.all
@pytest.mark.parametrize(
    ("scheme", "says", "message"),
    [
        ("tcp", b"", "within 0.5 s"),
        ("tls", b"", "within 0.5 s"),
        ("tcp", b"SSH-2.0-OpenSSH_9.2\r\n", "no Dask scheduler answers"),
        ("tls", b"SSH-2.0-OpenSSH_9.2\r\n", "WRONG_VERSION_NUMBER"),
    ],
)
def test_what_listens_and_is_no_scheduler(certificates: Path, scheme: str, says: bytes, message: str) -> None:
    """Dask's own client waits for ever in the first case and runs out of memory in the third."""

    def answer() -> socket.socket:
        connection, _ = server.accept()
        connection.recv(1)
        connection.sendall(says)
        return connection

    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:
        answered = pool.submit(answer)
        address = f"{scheme}://127.0.0.1:{server.getsockname()[1]}"
        with configured(certificates if scheme == "tls" else None), pytest.raises(ClusterError, match=message):
            check_connection(address, 0.5)
        answered.result().close()
