"""Name the places of the columns in a node's row: `row[node_row.STATUS] = "LOST"`.

A node's row is a list, because later events of its batch change it, and almost half of all events are starts of nodes:
a dict costs three times as much to make.
"""

from __future__ import annotations

from typing import Any, Final

from pycrorm_async.projections import columns

(
    ID,
    PROCESS_METADATA_ID,
    PARENT_ID,
    KIND,
    DTYPE,
    STATUS,
    START_TIME,
    START_NS,
    END_NS,
    END_SEQUENCE,
    REASON,
    FAILURE_MESSAGE,
    FAILURE_ARGUMENTS,
    RESULT,
    ROBOT_POSE_ID,
    TORSO_HEIGHT,
    ROBOT_TYPE,
    ROBOT_OBJECT_ID,
    ROBOT,
    SIMULATED,
) = range(20)
assert [each.lower() for each in globals() if each.isupper()] == [*columns.CORE["task_tree_node"]], "the order differs"

OUTCOME: Final = slice(REASON, RESULT + 1)
"""The columns reason to result."""
RUNNING: Final[list[Any]] = [None] * (SIMULATED + 1)
"""The row of a node that has started, to be copied and filled."""
RUNNING[STATUS], RUNNING[SIMULATED] = "RUNNING", False
