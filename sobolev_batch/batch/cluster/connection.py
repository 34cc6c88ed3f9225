"""The connection to a scheduler: why it fails, in words that say what to do."""

from __future__ import annotations

import asyncio
import os
import ssl
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from distributed import Security
from distributed.comm import CommClosedError, connect

from sobolev_batch.errors import ClusterError

_CONFIGURE = "export DASK_CONFIG=FOLDER/tls.yaml with the FOLDER that make-certificates made for it"


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
