"""The address of a scheduler or worker, and a check that only its user can reach it."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from typing import Self

from distributed.comm.addressing import parse_address, parse_host_port

from sobolev_batch.errors import AddressError, ClusterError

_ENCRYPTED = ("tls", "wss")
_PLAIN = ("tcp", "ws", "ucx", "ucxx")
_WITHIN_A_PROCESS = "inproc"


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


def _is_loopback(host: str) -> bool:
    address = ip_address(host)
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return (mapped or address).is_loopback


def _malformed(name: str, reason: str) -> AddressError:
    return AddressError(f"{name!r} is not the address of a scheduler ({reason}); one is tls://host:8786")
