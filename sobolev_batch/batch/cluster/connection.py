"""The connection to a scheduler: whether only its user can reach it, and why it fails, in words that say what to do."""

from __future__ import annotations

import asyncio
import os
import socket
import ssl
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from typing import Any, Self

from distributed import Security
from distributed.comm import CommClosedError, connect
from distributed.comm.addressing import parse_address, parse_host_port

from sobolev_batch.errors import AddressError, ClusterError

_ENCRYPTED = ("tls", "wss")
_PLAIN = ("tcp", "ws", "ucx", "ucxx")
_WITHIN_A_PROCESS = "inproc"
_CONFIGURE = "export DASK_CONFIG=FOLDER/tls.yaml with the FOLDER that make-certificates made for it"


@dataclass(frozen=True)
class Address:
    """An address at which a process of a cluster listens.

    Attributes:
        name: Address as it was given.
        scheme: Protocol, such as tls.
        host, port: Host and port; empty and 0 within a process.
    """

    name: str
    scheme: str
    host: str
    port: int

    @classmethod
    def of(cls, name: str) -> Self:
        """Return the address with this name; without a scheme, Dask's default is meant.

        Raises:
            AddressError: The name is malformed.
        """
        scheme, rest = parse_address(name)
        if scheme == _WITHIN_A_PROCESS:
            return cls(name, scheme, "", 0)
        if scheme not in (*_ENCRYPTED, *_PLAIN):
            raise _malformed(name, f"{scheme!r} is not one of {', '.join((*_ENCRYPTED, *_PLAIN))}")
        try:
            host, port = parse_host_port(rest)
        except ValueError as error:
            raise _malformed(name, str(error)) from error
        if not host or any(character.isspace() or character in "/@" for character in host):
            raise _malformed(name, f"{host!r} is no host")
        if not 0 < port < 65536:
            raise _malformed(name, f"{port} is no port")
        return cls(name, scheme, host, port)

    def require_private(self, who: str) -> None:
        """Check that nobody else reaches this address: it asks for certificates, or is on loopback.

        Args:
            who: Process that listens, for the message.

        Raises:
            AddressError: Others may reach it.
            ClusterError: The host does not exist.
        """
        if self.scheme in (*_ENCRYPTED, _WITHIN_A_PROCESS):
            return
        try:
            infos = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise ClusterError(f"no Dask scheduler answers at {self.name!r}: there is no host {self.host!r}") from error
        hosts = [str(socket_address[0]) for *_, socket_address in infos]
        beyond = [host for host in hosts if not _is_loopback(host)]
        if beyond:
            raise AddressError(
                f"{who} at {self.name} is neither encrypted nor on loopback ({beyond[0]}): everybody who reaches it "
                "could run programs on these machines and read the meshes. Use tls:// (docs/clusters.md), or "
                "--trust-network (in Python trust_network=True) where nobody else is on that network"
            )


def check_connection(address: str, seconds: float) -> None:
    """Shake hands with the scheduler at an address once.

    Dask's client says little of certificates, and waits for ever where something listens that is no scheduler.

    Raises:
        ClusterError: Nothing answers in time, or certificates and configuration do not fit.
    """
    security = Security()
    try:
        arguments = security.get_connection_args("client")
    except OSError as error:
        files = ", ".join(map(str, (security.tls_ca_file, security.tls_client_cert, security.tls_client_key)))
        raise ClusterError(
            f"the certificates of Dask's configuration ({_configuration()}) cannot be read ({error}): {files}"
        ) from error
    try:
        # In a thread: a notebook has a loop of its own running in this one.
        with ThreadPoolExecutor(1) as pool:
            pool.submit(asyncio.run, _shake_hands(address, seconds, arguments)).result()
    except (OSError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        raise ClusterError(_explanation(address, seconds, security, error)) from error


async def _shake_hands(address: str, seconds: float, arguments: dict[str, Any]) -> None:
    # The handshake that follows on the connection has no limit of its own.
    async with asyncio.timeout(seconds + 1):
        comm = await connect(address, timeout=seconds, **arguments)
        await comm.close()


def _explanation(address: str, seconds: float, security: Any, error: BaseException) -> str:
    encrypted = address.startswith("tls://")
    other = f"{'tcp' if encrypted else 'tls'}://{address.rpartition('://')[2]}"
    # The only ones that Dask raises as such: no certificates for tls://, and none used where they are demanded.
    if isinstance(error, TypeError):
        return f"{address} needs certificates, and Dask's configuration ({_configuration()}) names none; {_CONFIGURE}"
    if isinstance(error, RuntimeError):
        return (
            f"{address} is not encrypted, and Dask's configuration ({_configuration()}) demands encryption; "
            f"use {other}, or unset DASK_CONFIG for a scheduler without"
        )
    causes = [error, error.__cause__]
    if any(isinstance(cause, ssl.SSLCertVerificationError) for cause in causes):
        return (
            f"the certificate of the scheduler at {address} is not good for {security.tls_ca_file} "
            f"({error.__cause__}); use the certificates with which it was started"
        )
    said = " ".join(str(cause) for cause in causes if cause is not None)
    if "WRONG_VERSION_NUMBER" in said:
        return f"what answers at {address} is not encrypted; start the scheduler with --protocol tls, or use {other}"
    # The refusal itself does not always arrive before the end of the connection.
    if isinstance(error, CommClosedError) and encrypted:
        return (
            f"the scheduler at {address} refuses the certificate {security.tls_client_cert} ({error}); "
            "use the certificates with which it was started"
        )
    if isinstance(error, CommClosedError):
        return (
            f"what answers at {address} closes the connection; if it is a scheduler with certificates, "
            f"use {other} and {_CONFIGURE}"
        )
    reason = str(error) or "something listens and says nothing"
    return f"no Dask scheduler answers at {address!r} within {seconds:g} s ({reason}); start one with: dask scheduler"


def _configuration() -> str:
    return f"DASK_CONFIG={os.environ['DASK_CONFIG']}" if "DASK_CONFIG" in os.environ else "DASK_CONFIG is not set"


def _is_loopback(host: str) -> bool:
    address = ip_address(host)
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return (mapped or address).is_loopback


def _malformed(name: str, reason: str) -> AddressError:
    return AddressError(f"{name!r} is not the address of a scheduler ({reason}); one is tls://host:8786")
