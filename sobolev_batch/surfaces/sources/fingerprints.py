"""Parts of fingerprints: digests of files, and versions of the libraries that make surfaces."""

from __future__ import annotations

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sobolev_batch.errors import MeshError
from sobolev_batch.surfaces.formats.raw_files import checked_length, open_regular


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        MeshError: The file cannot be read.
    """
    try:
        with open_regular(path) as file:
            checked_length(file)
            return hashlib.file_digest(file, "sha256").hexdigest()
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error


def installed_version(distribution: str) -> str:
    """Return the installed version of a library whose output is part of a surface.

    Raises:
        MeshError: The library is not installed.
    """
    try:
        return version(distribution)
    except PackageNotFoundError as error:
        raise MeshError(
            f"this source needs the library {distribution}, which is not installed; install the extra: "
            "pip install 'sobolev-batch[studies]'"
        ) from error
