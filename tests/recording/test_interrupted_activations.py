"""Ctrl-C in the middle of recording an activation."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.record.recorded_episode import RecordedEpisode
from tests.recording.recorded_memory import assert_verified
from tests.recording.test_activations import Group, State, machine, nodes


def test_a_node_whose_start_was_written_directly_before_ctrl_c_is_not_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Group("job")
    grasp = State("grasp", job)
    start = RecordedEpisode.start

    def start_interrupted(*arguments: Any, **options: Any) -> None:
        start(*arguments, **options)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), machine(tmp_path) as running:
        with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
            patch.setattr(RecordedEpisode, "start", start_interrupted)
            running.tick((grasp, "busy"))
        grasp.work(KeyboardInterrupt())
    assert [(name, status) for name, _, status, _ in nodes(tmp_path)] == [("job", "CANCELLED"), ("grasp", "CANCELLED")]
    assert_verified(tmp_path)
