"""Write the scene at a moment as PNG.

Panel: Look at episodes, 5.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli.output import EpisodeArgument, JsonOption, parse_size, print_json, print_line
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.picture import picture as draw
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.snapshot import parse_moment
from pycrorm_async.report.output_files import refuse_existing, write_file


def picture(
    *,
    episode: EpisodeArgument,
    at: Annotated[
        str | None,
        typer.Option(
            help="The moment: seconds since the start (12.5), or after an event (e300);"
            " default: before the world is emptied.",
            metavar="WHEN",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.png", help="The file to write; default: episode-NUMBER.png.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="In pixels.")] = "640x480",
    focus: Annotated[
        str | None, typer.Option(metavar="OBJECT", help="Frame this object instead of those that move.")
    ] = None,
    yaw: Annotated[
        float | None,
        typer.Option(metavar="DEGREES", help="Look from this side, 0 from +x, 90 from +y; default: the best view."),
    ] = None,
    pitch: Annotated[float, typer.Option(metavar="DEGREES", help="Look from this angle above the scene.")] = 32.0,
    place: ReadingPlace,
    as_json: JsonOption = False,
) -> None:
    """Write the scene at a moment as PNG, drawn from the recorded geometry without a display."""
    width, height = parse_size("--size", size)
    if at is not None:
        parse_moment(at, "--at")
    if out is not None:
        if out.suffix.lower() != ".png":
            raise CallerError(f"--out {out} must end in .png")
        refuse_existing(out, force=force)

    async def write(reading: Reading) -> Path:
        number = (await reading.episode(episode)).number
        path = out if out is not None else Path(f"episode-{number}.png")
        refuse_existing(path, force=force)
        png = await draw(reading, number, at=at, width=width, height=height, yaw_deg=yaw, pitch_deg=pitch, focus=focus)
        write_file(png, path, force=force)
        return path

    path = place.read(write)
    if as_json:
        print_json({"file": path, "bytes": path.stat().st_size, "width": width, "height": height})
    else:
        print_line(path)
