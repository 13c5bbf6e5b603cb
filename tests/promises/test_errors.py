"""Errors reach the user whole, also from another process."""

import pickle
from pathlib import Path

import pytest

from pycrorm_async.errors import EpisodeParked, FlushTimeout, PycrormError, SpoolFull, SpoolUnavailable
from pycrorm_async.plan.failures import NotResolved, ResolutionError


@pytest.mark.parametrize(
    "error",
    [
        SpoolFull("the spool is full"),
        FlushTimeout(15.0, "no process drains this spool"),
        EpisodeParked({"an episode": "by hand"}),
        SpoolUnavailable(Path("spool"), "read-only file system"),
        ResolutionError("NavigateAction", missing=["target"]),
        NotResolved("NavigateAction", "perform"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_keeps_class_message_and_data_in_another_process(error: PycrormError) -> None:
    received = pickle.loads(pickle.dumps(error))
    assert (type(received), str(received), vars(received)) == (type(error), str(error), vars(error))
