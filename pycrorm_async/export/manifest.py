"""Describe an export in a file beside it, so that a data set can be made again and checked.

The manifest of `picks.parquet` is `picks.parquet.manifest.json`: the names and the query, the versions, the columns,
the episodes with the digests of their events, and the SHA-256 of each written file.
"""

from __future__ import annotations

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.export.selection import CoveredEpisode


class Manifest(msgspec.Struct, frozen=True, kw_only=True):
    """The description of an export.

    Attributes:
        format: version of this description.
        kind, names: `episodes` with their ids, `view` or `question` with its name, or `select`.
        file_format, options: as given.
        query: the SQL of the rows; empty for a format that is made from events.
        columns: the Arrow type of each column, by name.
        rows: number of rows, or of frames.
        versions: of the packages that wrote it.
        tables: version of the fold that made the tables.
        memory: id of the log.
        episodes: those that it covers.
        files: SHA-256 of each file, by name in the folder, or of the one file.
    """

    format: int = 1
    kind: str
    names: tuple[str, ...]
    file_format: str
    options: dict[str, Any] = {}
    query: str = ""
    columns: dict[str, str] = {}
    rows: int
    versions: dict[str, str]
    tables: int
    memory: str
    episodes: tuple[CoveredEpisode, ...]
    files: dict[str, str]


def manifest_path(path: Path) -> Path:
    """Return the file of the manifest of an export."""
    return path.with_name(f"{path.name}.manifest.json")


def read_manifest(path: Path) -> Manifest:
    """Read a manifest. Raises `CallerError` for another file, and for a manifest of a newer version."""
    try:
        manifest = msgspec.json.decode(path.read_bytes(), type=Manifest)
    except OSError as error:
        raise CallerError(f"the manifest {path} cannot be read: {error.strerror or error}") from None
    except msgspec.DecodeError as error:
        raise CallerError(f"{path} is not a manifest of an export: {error}") from None
    if manifest.format > Manifest.__struct_defaults__[0]:
        raise CallerError(f"{path} has the version {manifest.format}: use a newer pycrorm")
    return manifest


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of these others, as far as they are installed."""
    versions = {}
    for name in ("pycrorm-async", *packages):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def episode_differences(recorded: tuple[CoveredEpisode, ...], present: dict[str, CoveredEpisode]) -> list[str]:
    """Return a line for each episode of a manifest that the memory lacks, or has with other events."""
    lines = []
    for each in recorded:
        now = present.get(each.id)
        if now is None:
            lines.append(f"episode {each.number} ({each.id}) is not in this memory")
        elif now.events != each.events:
            lines.append(f"episode {now.number} ({each.id}) has {now.events} events instead of {each.events}")
        elif now.digest is not None and each.digest is not None and now.digest != each.digest:
            lines.append(f"episode {now.number} ({each.id}) has other events: its digest differs")
        elif now.number != each.number:
            lines.append(f"episode {each.number} ({each.id}) has the number {now.number} here, so its ids differ")
    return lines


def checksums(path: Path) -> dict[str, str]:
    """Return the SHA-256 of a file, or of each file in a folder, by name inside it."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    root = path if path.is_dir() else path.parent
    return {str(each.relative_to(root)): _sha256(each) for each in files}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
