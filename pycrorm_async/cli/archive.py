"""Move old episodes into a lake, a folder of Parquet files that many memories share.

Panel: Hand over, 3.
"""

from __future__ import annotations

import asyncio
from typing import Annotated

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.output import Form, LakeOption, parse_since, print_rows, problem
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.operations.archive import ArchiveSummary, archive_episodes
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.store.lake import shown


def archive(
    *,
    before: Annotated[str, typer.Option(metavar="AGE", help="Episodes that ended before then: 90d, 1y, or a date.")],
    lake: LakeOption = None,
    place: Place,
    form: Form,
) -> int:
    """Move episodes that ended before then from the memory into a lake, which is made if it is missing.

    Their events are read back and compared before they leave the log and the tables. `pycrorm restore` brings them
    back, `pycrorm lake query` reads them in SQL. Episodes that are refused, parked or not visible yet stay. Run it
    again after an interruption. It needs the extra `lake`, and on PostgreSQL the login that owns log and tables.
    """
    if lake is None:
        raise CallerError("name the lake with --to ducklake:FOLDER")
    collect_seldom()
    reason, before_this = f"archive --before {before}", parse_since(before)
    summary, fault = ArchiveSummary([], {}), None
    with progress_bar("archiving") as report:
        try:
            asyncio.run(
                archive_episodes(
                    place.url, lake, before=before_this, reason=reason, summary=summary, report_progress=report
                )
            )
        except PycrormError as error:
            if not summary.removed:
                raise
            fault = error
    rows = [(each.number, each.id, each.head, each.digest) for each in summary.removed]
    document = {"archived": [each._asdict() for each in summary.removed], "stayed": summary.stayed}
    print_rows(form, document, f"Archived in {shown(lake)}", ("episode", "id", "events", "digest"), rows)
    for name, why in summary.stayed.items():
        problem(f"episode {name} stays: {why}")
    if fault is not None:
        raise fault
    place.note_pending_events()
    return 4 if summary.stayed else 0
