"""Real servers on loopback, where this machine has them: SLURM with one node, and rclone's server of S3."""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from getpass import getuser
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from tests.support.object_storage import SECRET
from tests.support.processes import free_port, wait_until

_SLURM = ("slurmctld", "slurmd", "munged", "sbatch", "srun", "sinfo", "scancel")
# Debian has servers where the paths of users do not lead.
_PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"], "/usr/sbin"])


def required(*commands: str) -> list[str]:
    """Return the paths of commands; the test skips where one is not installed."""
    found = [shutil.which(command, path=_PATH) for command in commands]
    if lacking := [command for command, path in zip(commands, found, strict=True) if path is None]:
        pytest.skip(f"{', '.join(lacking)}: not installed")
    return [str(path) for path in found]


@contextmanager
def _running(*words: object, log: Path, **variables: str) -> Iterator[subprocess.Popen[bytes]]:
    with (
        log.open("wb") as file,
        subprocess.Popen([*map(str, words)], stdout=file, stderr=file, env={**os.environ, **variables}) as process,
    ):
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


@contextmanager
def slurm() -> Iterator[dict[str, str]]:
    """Start SLURM, with one node of two cores and the partition of the recipes; yield its environment."""
    controller, daemon, munged, *_ = required(*_SLURM)
    # Sockets have short paths.
    with TemporaryDirectory(prefix="slurm-", dir="/tmp") as name, ExitStack() as stack:
        folder, host, user = Path(name), socket.gethostname().split(".")[0], getuser()
        folder.chmod(0o755)
        (folder / "key").write_bytes(secrets.token_bytes(128))
        (folder / "key").chmod(0o600)
        places = {
            "key-file": "key",
            "socket": "socket",
            "pid-file": "pid",
            "log-file": "munge.log",
            "seed-file": "seed",
        }
        options = [f"--{option}={folder / place}" for option, place in places.items()]
        stack.enter_context(_running(munged, "--foreground", "--force", *options, log=folder / "munged.out"))
        wait_until((folder / "socket").exists)
        ports = {free_port() for _ in range(8)}
        settings = {
            "ClusterName": "tests", "SlurmctldHost": f"{host}(127.0.0.1)", "SlurmUser": user, "SlurmdUser": user,
            "SlurmctldPort": ports.pop(), "SlurmdPort": ports.pop(), "AuthType": "auth/munge",
            "AuthInfo": f"socket={folder / 'socket'}", "CredType": "cred/munge", "StateSaveLocation": folder / "state",
            "SlurmdSpoolDir": folder / "spool", "SlurmctldPidFile": folder / "ctld.pid",
            "SlurmdPidFile": folder / "slurmd.pid", "ProctrackType": "proctrack/linuxproc", "TaskPlugin": "task/none",
            "SwitchType": "switch/none", "MpiDefault": "none", "SelectType": "select/cons_tres",
            "SelectTypeParameters": "CR_Core", "SlurmdParameters": "config_overrides", "ReturnToService": 2,
            "SchedulerParameters": "sched_interval=1,batch_sched_delay=0",
        }  # fmt: skip
        lines = [f"{option}={value}" for option, value in settings.items()]
        node = f"NodeName={host} NodeAddr=127.0.0.1 CPUs=16 RealMemory=65536 State=UNKNOWN"
        lines += [node, f"PartitionName=compute Nodes={host} Default=YES MaxTime=INFINITE State=UP"]
        (folder / "slurm.conf").write_text("\n".join(lines) + "\n")
        environment = {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": _PATH}
        for server in (controller, daemon):
            log = folder / f"{Path(server).name}.out"
            stack.enter_context(_running(server, "-D", log=log, **environment))

        def is_idle() -> bool:
            asked = ["sinfo", "--noheader", "--format=%T"]
            found = subprocess.run(
                asked, env={**os.environ, **environment}, capture_output=True, text=True, check=False
            )
            return found.stdout.strip() == "idle"

        wait_until(is_idle)
        yield environment


@contextmanager
def rclone(folder: Path) -> Iterator[dict[str, str]]:
    """Start rclone's server of S3, whose buckets are the folders of one; yield the environment of its clients."""
    (program,) = required("rclone")
    port = free_port()
    options = ["--addr", f"127.0.0.1:{port}", "--auth-key", f"tester,{SECRET}", "--vfs-cache-mode", "off"]
    with _running(program, "serve", "s3", *options, folder, log=folder.with_suffix(".log"), RCLONE_CONFIG="/dev/null"):

        def answers() -> bool:
            with suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)):
                return True
            return False

        wait_until(answers)
        yield {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": "tester",
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "us-east-1",
        }
