"""Bring archived episodes back from a lake into a memory.

Panel: Hand over, 4.
"""

from __future__ import annotations

from typing import Annotated

import typer

from pycrorm_async.cli.copy import copy
from pycrorm_async.cli.output import Form, LakeOption
from pycrorm_async.cli.reading import Place
from pycrorm_async.errors import CallerError


def restore(
    *,
    episodes: Annotated[list[str], typer.Argument(metavar="EPISODE...", help="Ids, or first digits of them.")],
    lake: LakeOption = None,
    place: Place,
    form: Form,
) -> int:
    """Bring episodes of a lake back into the memory, each under the number that it had there, and fold them.

    They stay in the lake. It is safe to repeat: events that are there are compared. An episode that the memory has
    erased is refused. `pycrorm copy --from LAKE --to URL` does the same with all episodes.
    """
    if lake is None:
        raise CallerError("name the lake with --from ducklake:FOLDER")
    return copy(source=lake, target=place.url, episode=episodes, spool=place.spool, form=form)
