"""Find the format of an import by its name, read its map file, and run it on a memory, or count what it would record.

>>> with Memory.sync("sqlite:///memory.db") as memory:
...     import_files("trace", ["run.json"], memory.recording)
ImportReport(format='trace', episodes=[EpisodeReport(id='432178db-930b-5aac-b76f-4affd3efcf41', …)], …)

A package adds a format with an entry point in the group `pycrorm.import_formats`, whose name is that of the format and
whose value is an `ImportFormat`.
"""

from collections.abc import Container, Iterable, Sequence
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Final

import msgspec

from pycrorm_async.errors import CallerError
from pycrorm_async.export.formats import offered_format
from pycrorm_async.imports.intake import ImportFormat, ImportReport, Intake, MapFile
from pycrorm_async.progress_bar import ProgressCallback
from pycrorm_async.record.recording import Recording

GROUP: Final = "pycrorm.import_formats"
"""The group of the entry points of formats."""
BUILT_IN: Final = {
    "trace": "trace",
    "btlog": "btlog",
    "mcap": "bags",
    "rosbag2": "bags",
    "lerobot": "lerobot",
    "neem": "neem",
    "pycrorm": "pycram_orm",
}
"""The modules of the built-in formats, by name, loaded when they are used. `FORMAT` in each is its `ImportFormat`."""


def format_named(name: str) -> ImportFormat:
    """Return the format of this name. Raises `CallerError`."""
    if name in BUILT_IN:
        built_in: ImportFormat = import_module(f"pycrorm_async.imports.{BUILT_IN[name]}").FORMAT
        return built_in
    offered: ImportFormat = offered_format(GROUP, BUILT_IN, name)
    return offered


def read_map_file(path: Path | None, map_file: type[MapFile]) -> MapFile:
    """Read the settings of an import. Raises `CallerError` for a file that cannot be read, or has an unknown key."""
    if path is None:
        return map_file()
    try:
        return msgspec.toml.decode(path.read_bytes(), type=map_file)
    except OSError as error:
        raise CallerError(f"the map file {path} cannot be read: {error.strerror or error}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        keys = ", ".join(map_file.__struct_fields__)
        raise CallerError(f"the map file {path} does not fit: {error}; keys of this format: {keys}") from None


def import_files(
    file_format: str,
    paths: Iterable[str | PathLike[str]],
    recording: Recording | None,
    *,
    map_file: Path | None = None,
    stored: Container[str] = (),
    report_progress: ProgressCallback | None = None,
) -> ImportReport:
    """Import files into the memory of `recording`; without one, count what would be recorded.

    Each path is read apart, and a path that is cut in the middle does not stop the next one. An episode that the memory
    holds already is not recorded again; a dry run knows them from `stored`, their ids.

    Raises:
        CallerError: the format, the map file or a path is unknown, or a file is of another format. Nothing of that path
            is recorded then.
        MissingExtra: the format needs a package that is not installed.
    """
    chosen = format_named(file_format)
    settings = read_map_file(map_file, chosen.map_file)
    present: Sequence[Path] = [Path(each) for each in paths]
    for path in present:
        try:
            path.stat()
        except (FileNotFoundError, NotADirectoryError):
            raise CallerError(f"{path} does not exist") from None
        except OSError as error:
            raise CallerError(f"{path} cannot be read: {error.strerror or error}") from None
    intake = Intake(file_format, settings, recording, stored, report_progress)
    for path in present:
        try:
            chosen.read(path, settings, intake)
        except OSError as error:
            raise CallerError(f"{path} cannot be read: {error.strerror or error}") from None
    return intake.report
