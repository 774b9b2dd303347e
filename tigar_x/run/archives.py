"""Archives of arrays under a digest, written at once or not at all: NumPy's, uncompressed, without pickled objects."""

import hashlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tigar_x.run.writing import replace_bytes


class DamagedError(ValueError):
    """A checkpoint that is truncated or was changed."""


def write_archive(path: Path, arrays: Mapping[str, Any]) -> str:
    """Write arrays under their digest, which is returned.

    Args:
        path: the file.
        arrays: NumPy arrays by name.

    Raises:
        OSError: it cannot be written; an old file stays as it was.
    """
    buffer, digest = io.BytesIO(), digest_of(arrays)
    np.savez(buffer, digest=np.array(digest), **arrays)
    replace_bytes(path, buffer.getvalue())
    return digest


def read_archive(path: Path, required: str | None = None) -> dict[str, Any]:
    """All arrays of an archive that is whole.

    Args:
        path: its file.
        required: the digest that it has to have; None: its own.

    Raises:
        FileNotFoundError: there is none.
        DamagedError: it is not whole, or another one.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such checkpoint")
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        digest = str(arrays.pop("digest"))
    except Exception as error:  # there is no end to what a damaged archive may raise
        raise DamagedError(f"{path}: not a checkpoint, or a truncated one ({error})") from error
    if digest != digest_of(arrays) or required not in (None, digest):
        raise DamagedError(f"{path}: the contents do not agree with their digest")
    return arrays


def digest_of(arrays: Mapping[str, Any]) -> str:
    """SHA-256 over names, types, shapes and contents."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        total.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()
