"""A rebuild with fold workers in a daemonic process of multiprocessing, which must not start processes."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import pytest

from pycrorm_async.operations.rebuild import rebuild_memory
from tests.commands import FORKED, fork
from tests.projections.factories import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


def rebuild_with_two_workers(url: str, output: str) -> None:
    logging.basicConfig(filename=output, format="%(message)s", level="WARNING")
    asyncio.run(rebuild_memory(url, workers=2))


def test_a_rebuild_in_a_daemonic_process_folds_without_workers(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    asyncio.run(append_and_fold(url, [*TYPES, *picking(1).records]))
    before = tables_of(url)
    arguments = (url, f"{tmp_path}/log")
    process = FORKED.Process(target=rebuild_with_two_workers, args=arguments, daemon=True)
    fork(process)
    process.join(120)
    assert process.exitcode == 0
    assert differences(before, tables_of(url)) == []
    assert (tmp_path / "log").read_text() == (  # once, and without waiting to try again
        "a daemonic process of multiprocessing cannot start fold workers; it folds without them\n"
    )
