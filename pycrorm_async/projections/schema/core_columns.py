"""List the columns of the tables that every memory has."""

from __future__ import annotations

from typing import Literal, TypeAlias

Storage: TypeAlias = Literal[
    "key", "row", "pose", "object", "integer", "real", "text", "boolean", "time", "json", "bytes", "number"
]
"""The storage of a column: part of the key, the id of a row (of `pose`, of `object`), a scalar, µs since 1970, JSON,
bytes, or the number of an episode or of an event, which 32 bits hold."""

OWN = "pycrorm_own_"
"""The prefix of the tables of custom projections, so that they never collide with the table of a designator."""
EPISODE = "process_metadata_id"
"""The column that names the episode of a row. In `process_metadata` and `simulated_episode` it is `id`."""

_POSE: dict[str, Storage] = {
    "x": "real",
    "y": "real",
    "z": "real",
    "qx": "real",
    "qy": "real",
    "qz": "real",
    "qw": "real",
    "frame": "text",
}

_ROW: dict[str, Storage] = {"id": "key", "process_metadata_id": "number"}
_ITEM: dict[str, Storage] = {"id": "key", "position": "key", "process_metadata_id": "number"}

CORE: dict[str, dict[str, Storage]] = {
    "process_metadata": {
        "id": "key",
        "uuid": "text",
        "created_at": "time",
        "created_by": "text",
        "description": "text",
        "version": "text",
        "host": "text",
        "python": "text",
        "plan": "text",
        "world": "text",
        "seed": "integer",
        "status": "text",
        "ended_at": "time",
        "end_sequence": "number",
        "failure_type": "text",
        "failure_message": "text",
        "simulated": "boolean",
        "thought_by": "text",
        "thought_by_node": "integer",
        "continues": "text",
        "continued_in": "text",
        "plan_sha256": "text",
        "git_commit": "text",
        "git_dirty": "boolean",
        "libraries": "json",
        "settings": "json",
        "clock_synchronized": "boolean",
        "clock_error_us": "integer",
        "entered_world": "text",
        "metadata": "json",
    },
    "episode_tagging": {
        **_ITEM,
        "tag": "text",
        "added": "boolean",
        "time": "time",
    },
    "simulated_episode": {"id": "key"},
    "task_tree_node": {
        **_ROW,
        "parent_id": "row",
        "kind": "text",
        "dtype": "text",
        "status": "text",
        "start_time": "time",
        "end_time": "time",
        "start_ns": "integer",
        "end_ns": "integer",
        "end_sequence": "number",
        "reason": "text",
        "failure_message": "text",
        "failure_arguments": "json",
        "result": "json",
        "robot_pose_id": "pose",
        "torso_height": "real",
        "robot_type": "text",
        "robot_object_id": "object",
        "robot": "text",
        "simulated": "boolean",
        "parameters": "json",
    },
    "pose": {"id": "key", "process_metadata_id": "number", **_POSE, "time": "time"},
    "object": {
        **_ROW,
        "dtype": "text",
        "name": "text",
        "obj_type": "text",
        "pose_id": "pose",
        "part_of_id": "object",
        "identity_id": "object",
        "time": "time",
        "node_id": "row",
        "joints": "json",
        "description_fingerprint": "text",
        "color": "json",
        "model": "text",
        "serial": "text",
        "mass_kg": "real",
        "base_link": "text",
    },
    "object_removal": {
        **_ROW,
        "object_id": "object",
        "identity_id": "object",
        "time": "time",
        "node_id": "row",
    },
    "parameter_item": {
        "node_id": "key",
        "field": "key",
        "position": "key",
        "process_metadata_id": "number",
        "key": "text",
        "integer": "integer",
        "real": "real",
        "text": "text",
        "boolean": "boolean",
        "time": "time",
        **_POSE,
        "object_id": "object",
        "object_name": "text",
        "obj_type": "text",
    },
    "attachment": {
        **_ROW,
        "kind": "text",
        "parent_id": "object",
        "child_id": "object",
        "link": "text",
        "time": "time",
        "node_id": "row",
    },
    "joint_change": {
        "id": "key",
        "joint": "key",
        "process_metadata_id": "number",
        "object_id": "object",
        "position": "real",
        "time": "time",
        "node_id": "row",
    },
    "location_resolution": {
        **_ROW,
        "node_id": "row",
        "location": "text",
        "considered": "integer",
        "offered": "integer",
        "taken": "integer",
        "pose_id": "pose",
        "time": "time",
        "refused": "integer",
        "occupied_cells": "integer",
        "hidden_cells": "integer",
        "free_cells": "integer",
    },
    "location_candidate": {
        "resolution_id": "key",
        "position": "key",
        "process_metadata_id": "number",
        **_POSE,
        "arms": "text",
        "taken": "boolean",
        "grasp": "text",
        "torso_height": "real",
    },
    "location_refusal": {
        "resolution_id": "key",
        "position": "key",
        "process_metadata_id": "number",
        **_POSE,
        "reason": "text",
    },
    "detection": {
        **_ITEM,
        "node_id": "row",
        "source": "text",
        "looked_for": "text",
        "object_id": "object",
        "name": "text",
        "obj_type": "text",
        **_POSE,
        "visible": "real",
        "confidence": "real",
        "time": "time",
    },
    "state_sample": {
        "id": "key",
        "channel": "key",
        "process_metadata_id": "number",
        "object_id": "object",
        "node_id": "row",
        "value": "real",
        "time": "time",
        "ns": "integer",
    },
    "observation": {
        **_ROW,
        "node_id": "row",
        "name": "text",
        "time": "time",
        "ns": "integer",
    },
    "observation_value": {
        **_ITEM,
        "key": "text",
        "number": "real",
        "text": "text",
        "truth": "boolean",
        "blob": "text",
        "media_type": "text",
        "size": "integer",
        "missing": "text",
    },
}
"""The columns of each table, in the order in which the fold writes their values.

`simulated_episode` has no view. It repeats the ids of simulations, so that every view can exclude their rows by a
lookup in a small table that consists of its key only.
"""

LINK_BOX = "pycrorm_link_box"
OF_NO_EPISODE: dict[str, dict[str, Storage]] = {
    LINK_BOX: {
        "model": "key",
        "position": "key",
        "link": "text",
        "joint": "text",
        **{f"{letter}{axis}": "real" for letter in "cha" for axis in "xyz"},
    },
}
"""Columns of the table of the boxes around the links of descriptions, which belong to no episode; it has no view.

A box has the fingerprint of its description as `model`, its centre, half of its edges, and the direction in which its
joint slides it; in m, in the frame of the root link.
"""

COLUMNS = {table: tuple(columns) for table, columns in CORE.items()}
