"""Write an episode, or a table of all of them, as HTML that opens offline.

Panel: Look at episodes, 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.query.named_queries import EpisodeChoice
from pycrorm_async.report.overview import Overview, Plot, overview
from pycrorm_async.report.pictures import Images
from pycrorm_async.report.write import Report
from pycrorm_async.report.write import report as write_report


def report(
    *,
    episode: Annotated[
        str | None, typer.Argument(help="The episode's number, its id or first digits of the id, or `last`.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Write a table of the episodes, and pages of the newest 200 behind it.")
    ] = False,
    chosen: output.Chosen,
    plot: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y[,VIEW]",
            help="With --all: how often actions succeeded over these columns, as `pycrorm plot` draws it; repeatable.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.html",
            help="The file to write; default: episode-NUMBER.html, episodes.html. With --all also a folder.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
    first: Annotated[
        int | None, typer.Option("--from", min=1, metavar="SEQUENCE", help="Show events from this one on.")
    ] = None,
    last: Annotated[
        int | None, typer.Option("--to", min=1, metavar="SEQUENCE", help="Show events up to this one.")
    ] = None,
    images: Annotated[
        Images,
        typer.Option(
            help="What the page has of observed images, depth maps and point clouds: nothing; small pictures of at most"
            " 200; or the whole contents, up to 24 MB, and small pictures of the others."
        ),
    ] = "thumbs",
    place: ReadingPlace,
    as_json: output.JsonOption = False,
) -> int:
    """Write an episode as one HTML page that opens offline: task tree, Gantt chart, 3D scene, failures.

    --status, --since, --tag, --robot, --text and --limit choose among the episodes of --all, as in `pycrorm episodes`.
    Exit code 1 if --all met an episode whose events cannot be read; its row has the error, and all others have pages.
    """
    if every and episode is not None:
        raise CallerError(f"name the episode {episode} or write all of them with --all, not both")
    if not every and episode is None:
        raise CallerError("name an episode, for example `pycrorm report last`, or write all of them with --all")
    choice = chosen.choice()
    if not every and choice != EpisodeChoice():
        raise CallerError(f"an option chooses among all episodes ({choice}): add --all")
    if not every and plot:
        raise CallerError("--plot draws successes of many episodes: add --all")
    if every and (first is not None or last is not None):
        raise CallerError("--from and --to choose events of one episode: name it instead of --all")
    if episode is None:
        plots, file = [_plot(each) for each in plot or ()], out or Path("episodes.html")
        written = place.read(
            lambda reading: overview(reading, file, choice=choice, plots=plots, force=force, images=images)
        )
        _print_overview(written, file, as_json=as_json)
        return 1 if written.unreadable else 0
    page = place.read(
        lambda reading: write_report(reading, episode, out, force=force, first=first, last=last, images=images)
    )
    _print_episode(page, last, as_json=as_json)
    return 0


def _plot(text: str) -> Plot:
    names = [each.strip() for each in text.split(",")]
    if len(names) not in (2, 3) or not all(names):
        raise CallerError(f"--plot {text!r} must be X,Y or X,Y,VIEW, for example arm,grasp,PickUpAction")
    return Plot(*names)


def _print_overview(written: Overview, out: Path, *, as_json: bool) -> None:
    if as_json:
        counts = {"episodes": written.episodes, "pages": written.pages, "left_out": written.left_out}
        output.print_json({"file": written.path, **counts, "unreadable": written.unreadable})
    else:
        output.print_line(written.path)
        episodes = output.counted(written.episodes, "episode")
        listed = f"the newest {episodes} of {written.left_out + written.episodes:,}" if written.left_out else episodes
        where = f"in {out.stem}.pages beside it" if written.path == out else "beside it"
        output.note(f"It has {listed}; pages of {written.pages} are {where}.")
        if written.left_out:
            output.note("--since, --status, --tag, --robot and --text choose others.")
        if written.pages + len(written.unreadable) < written.episodes:
            output.note("The others have no page: `pycrorm report NUMBER` writes one.")
    for number, reason in written.unreadable.items():
        output.problem(f"episode {number} has no page: {reason}")


def _print_episode(written: Report, last: int | None, *, as_json: bool) -> None:
    size = written.path.stat().st_size
    if as_json:
        shown = {"first": written.first, "last": written.last, "events": written.events}
        output.print_json({"file": written.path, "bytes": size, **shown})
        return
    output.print_line(written.path)
    output.note(f"The page has {size / 1e6:.1f} MB and opens in any browser, also offline.")
    if written.last < min(last or written.events, written.events):  # it ends before the last event asked for
        output.note(
            f"It shows the events {written.first} to {written.last} of {written.events}, because a page holds no more;"
            f" the next page: --from {written.last + 1}"
        )
