"""Make a member of the zoo: a small memory and its spool in the format of today, to be read by all later versions.

    python -m tests.golden.zoo tests/golden/zoo/fold_8.tar.gz

Each version of the fold (`PROJECTION_VERSION`) made one member, and so did others that changed the tables, the spool or
the blobs, as the names say. Run this before `PROJECTION_VERSION` is raised, unless the zoo has the version already.

The memory holds an episode with one action that succeeded and one that failed. Its spool is that of a recorder that
died in a second episode, after an action.
"""

import asyncio
import os
import sys
import tarfile
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract, PlanFailure

__all__ = ["ZOO", "PourActionPerformable"]

ZOO = Path(__file__).with_suffix("")
SETTINGS = Settings(segment_bytes=2**15, record_bytes_max=2**12, spool_bytes_max=2**20, spool_reserve_bytes=2**16)


@dataclass
class PourActionPerformable(ActionAbstract):
    into: str
    litres: float

    async def perform(self) -> None:
        if self.litres > 1:
            raise PlanFailure(f"{self.into} is full")


async def _make_and_die(url: str) -> NoReturn:
    async with Memory.open(url, settings=SETTINGS) as memory:
        async with memory.episode(description="poured"):
            await PourActionPerformable("glass", 0.25).perform()
            memory.observe("level", {"litres": 0.25})
            with suppress(PlanFailure):
                await PourActionPerformable("bowl", 1.5).perform()
        await memory.flush()
    memory = await Memory.open(url, settings=SETTINGS).__aenter__()
    episode = memory.episode(description="cut short")  # a block that is dropped would end its episode
    await episode.__aenter__()
    await PourActionPerformable("jug", 0.5).perform()
    await memory.synced()
    os._exit(0)


def main(archive: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        child = os.fork()
        if child == 0:
            asyncio.run(_make_and_die(f"sqlite:///{folder}/memory.db"))
        os.waitpid(child, 0)
        with tarfile.open(archive, "w:gz") as packed:
            for path in sorted(Path(folder).iterdir()):
                packed.add(path, path.name, filter=_without_owner)


def _without_owner(member: tarfile.TarInfo) -> tarfile.TarInfo:
    member.uid = member.gid = member.mtime = 0
    member.uname = member.gname = ""
    return member


if __name__ == "__main__":
    main(Path(sys.argv[1]))
