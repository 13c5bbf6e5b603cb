"""Record, by the public seam, episodes in which every text has control characters: an ESC, a C1 and a bidi one."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from pycrorm_async.events.types import SeenValue
from pycrorm_async.memory import Memory
from pycrorm_async.record.arguments import pose_of
from pycrorm_async.world import Pose

BAD = "\x1b]0;owned\x07\x1b[31m\x9b32m\x9d8;;x\x9c\x85\x7f\u202e\u2066\u200f\r\x08"
DRIVES_A_TERMINAL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def record_hostile_episodes(path: Path) -> str:
    """Return the URL of a memory of three episodes: two hostile ones and a clean one, which is the last."""
    url = f"sqlite:///{path}"
    with Memory.sync(url) as memory:
        clean = memory.recording.type("action", "CleanAction", {"what": str})
        kind = memory.recording.type(
            "action", f"Wipe{BAD}Action", {f"text{BAD}": str, "what": str, "notes": list[str], "more": dict[str, str]}
        )
        for number in range(2):
            with (
                suppress(RuntimeError),
                memory.recording.episode(description=f"wipe {BAD} it", metadata={f"k{BAD}": BAD}) as episode,
            ):
                with suppress(Exception):  # a tag may be refused
                    episode.tag(f"tag{BAD}")
                for each in ("GENERIC_OBJECT", "MILK", "ROBOT", "ENVIRONMENT", f"CUP{BAD}"):
                    episode.object_added(
                        each, f"{each} {BAD}\ufffe", each, Pose([1, 0, 0]), {f"hinge{BAD}": 0.5}, serial=BAD, model=BAD
                    )
                episode.object_attached("ROBOT", "MILK", f"hand{BAD}")
                episode.start(
                    "one",
                    kind,
                    {f"text{BAD}": BAD, "what": BAD, "notes": [BAD], "more": {"position": BAD}},
                    robot="ROBOT",
                )
                episode.observe(f"force{BAD}", {f"n{BAD}": BAD, "list": [BAD, 1]}, node="one")
                seen = SeenValue(f"seen{BAD}", f"CUP{BAD}", pose_of(Pose([0, 0, 1])), None, 1.0)
                episode.detected([seen], object_type=f"CUP{BAD}", node="one")
                episode.end("one", "FAILED", f"went {BAD} wrong")
                episode.start("two", clean, {"what": f"{BAD}{number}"}, robot="ROBOT")
                episode.object_moved("MILK", Pose([2, number, 0]), node="two")
                for place in (3, 4):
                    episode.object_moved("ROBOT", Pose([place, number, 0]), node="two")
                episode.end("two", "SUCCEEDED")
                raise RuntimeError(f"ended {BAD}")
        with memory.recording.episode(description="clean") as episode:
            episode.object_added("ROBOT", "turtle", "ROBOT", Pose([0, 0, 0]), {f"hinge{BAD}": 0.5})
            episode.start("one", clean, {"what": "table"})
            for place in (3, 4):
                episode.object_moved("ROBOT", Pose([place, 0, 0]), node="one")
            episode.end("one", "SUCCEEDED")
        memory.flush()
    return url
