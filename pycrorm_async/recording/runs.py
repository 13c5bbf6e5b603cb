"""`Runs` records an executive that names each run by an id, and that declares no types: an agent, a workflow engine.

>>> with Runs(memory.recording, "my_engine 1.0", description="Bring milk") as runs:
...     runs.start("run 1", "action", "pick_up", {"object_name": "milk", "force_n": 5})
...     runs.end("run 1", result="picked milk")
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, Final

from pycrorm_async.events.values import FailureValue, NodeStatus
from pycrorm_async.recording.declarations.recorded_type import FieldSpec, RecordedKind
from pycrorm_async.recording.episode_block import EpisodeBlock
from pycrorm_async.recording.values.plain_values import json_text, plain_value

_NUMBERS: Final[Mapping[type, FieldSpec]] = {bool: "boolean", int: "real", float: "real"}
"""Field types of inputs that are not text. A program writes the same real number as 1 and as 1.0."""


class Runs(EpisodeBlock):
    """Records the runs that are reported while its `with` block is open, from any thread, as one episode.

    Some events of a run may go elsewhere, so a parent or a run that is not open is no fault. Models of pydantic,
    dataclasses, and mappings and sequences of them are recorded as dicts and lists.

    Attributes:
        episode: its keys of nodes are the ids of runs.
    """

    def start(
        self,
        run_id: Hashable,
        kind: RecordedKind,
        dtype: str,
        inputs: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
    ) -> None:
        """Record that a run started, below its parent if that is open.

        Args:
            inputs: the parameters. A number has a `real` field, a truth value a `boolean` one, all others a `text`,
                which is JSON unless they are texts; an input that is None declares no field.
        """
        inputs = {name: value for name, value in inputs.items() if value is not None}
        fields = {name: _NUMBERS.get(type(value), "text") for name, value in inputs.items()}
        parameters = {
            name: value if isinstance(value, str | int | float) else json_text(value, self.simplified)
            for name, value in inputs.items()
        }
        declared = self._recording.type(kind, dtype, fields)
        self.episode.start(run_id, declared, parameters, parent=parent if self.episode.is_open(parent) else None)

    def end(
        self,
        run_id: Hashable,
        status: NodeStatus | None = None,
        failure: BaseException | FailureValue | str | None = None,
        result: Any = None,
    ) -> None:
        """Record that a run ended, as `RecordedEpisode.end` does, if it is open."""
        if self.episode.is_open(run_id):
            self.episode.end(run_id, status, failure, plain_value(result, self.simplified))

    def observe(self, name: str, values: Any, run_id: Hashable | None = None) -> None:
        """Record an observation of a run; of the episode if the run is not open."""
        node = run_id if self.episode.is_open(run_id) else None
        self.episode.observe(name, plain_value(values, self.simplified), node=node)

    def simplified(self, value: Any) -> Any:
        """Return the scalar, dict or list that is recorded for a value; override it for classes with parts of no use.

        It is not called for a scalar, dict or list, but for each value inside one.
        """
        return value
