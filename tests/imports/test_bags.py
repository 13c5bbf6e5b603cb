"""Bags of ROS 2, written by rosbags, become episodes."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags")
import mcap.reader
import mcap.writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pycrorm_async.errors import CallerError
from pycrorm_async.imports import registry
from pycrorm_async.imports.ros_messages import RosMap
from tests.databases import ask
from tests.imports.importing import imported, poses, tree

AT = 1_700_000_000 * 10**9
MS = 10**6
STORE = get_typestore(Stores.ROS2_JAZZY)
NAVIGATE = {
    "nav/msg/Goal": "geometry_msgs/PoseStamped pose\nstring behavior_tree",
    "nav/msg/Navigate_SendGoal_Request": "unique_identifier_msgs/UUID goal_id\nnav/Goal goal",
    "nav/msg/Navigate_SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
    "nav/msg/Navigate_SendGoal_Event": (
        "service_msgs/ServiceEventInfo info\nnav/Navigate_SendGoal_Request[<=1] request\n"
        "nav/Navigate_SendGoal_Response[<=1] response"
    ),
}
Row = tuple[int, str, str, Any]


def message(type_name: str, /, **fields: Any) -> Any:
    return STORE.types[type_name](**fields)


def time_of(ns: int) -> Any:
    return message("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)


def header(frame: str, ns: int = AT) -> Any:
    return message("std_msgs/msg/Header", stamp=time_of(ns), frame_id=frame)


def tf(*links: tuple[str, str, tuple[float, float, float], float]) -> Any:
    """Return the transforms of (parent, child, translation, yaw)."""

    def stamped(parent: str, child: str, xyz: tuple[float, float, float], yaw: float) -> Any:
        x, y, z = xyz
        translation = message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        rotation = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        transform = message("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        return message(
            "geometry_msgs/msg/TransformStamped", header=header(parent), child_frame_id=child, transform=transform
        )

    return message("tf2_msgs/msg/TFMessage", transforms=[stamped(*each) for each in links])


def tf_row(ms: int, *links: tuple[str, str, tuple[float, float, float], float], topic: str = "/tf") -> Row:
    return AT + ms * MS, topic, "tf2_msgs/msg/TFMessage", tf(*links)


def joints_row(ms: int, **positions: float) -> Row:
    import numpy as np

    state = message(
        "sensor_msgs/msg/JointState",
        header=header(""),
        name=list(positions),
        position=np.array([*positions.values()]),
        velocity=np.array([]),
        effort=np.array([]),
    )
    return AT + ms * MS, "/joint_states", "sensor_msgs/msg/JointState", state


def goal_id(number: int) -> Any:
    import numpy as np

    return message("unique_identifier_msgs/msg/UUID", uuid=np.full(16, number, dtype=np.uint8))


def status_row(ms: int, action: str, *goals: tuple[int, int, int]) -> Row:
    """Return the statuses of goals: number, ms of its acceptance, status."""
    listed = [
        message(
            "action_msgs/msg/GoalStatus",
            goal_info=message("action_msgs/msg/GoalInfo", goal_id=goal_id(number), stamp=time_of(AT + accepted * MS)),
            status=status,
        )
        for number, accepted, status in goals
    ]
    array = message("action_msgs/msg/GoalStatusArray", status_list=listed)
    return AT + ms * MS, f"{action}/_action/status", "action_msgs/msg/GoalStatusArray", array


def log_row(ms: int, level: int, text: str) -> Row:
    line = message(
        "rcl_interfaces/msg/Log", stamp=time_of(AT), level=level, name="nav", msg=text, file="", function="", line=1
    )
    return AT + ms * MS, "/rosout", "rcl_interfaces/msg/Log", line


def text_row(ms: int, topic: str, text: str) -> Row:
    return AT + ms * MS, topic, "std_msgs/msg/String", message("std_msgs/msg/String", data=text)


def bag(folder: Path, rows: Iterable[Row], plugin: StoragePlugin = StoragePlugin.MCAP, store: Any = STORE) -> Path:
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for at, topic, type_name, content in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=store)
            data = content if isinstance(content, bytes) else store.serialize_cdr(content, type_name)
            writer.write(connections[topic], at, data)
    return folder


def a_drive() -> Iterable[Row]:
    """Yield 2 s: the robot drives 1 m in odom, which lies 10 m along x in map, turned by a right angle."""
    yield tf_row(
        0, ("map", "table", (3.0, 0.0, 0.5), 0.0), ("table", "milk", (0.0, 0.25, 0.5), 0.0), topic="/tf_static"
    )
    links = ("base_footprint", "base_link", (0.0, 0.0, 0.1), 0.0), ("base_link", "camera", (0.1, 0.0, 1.0), 0.0)
    yield tf_row(0, ("map", "odom", (10.0, 0.0, 0.0), math.pi / 2), *links)
    yield tf_row(1, ("nowhere", "ghost", (0.0, 0.0, 0.0), 0.0))
    yield joints_row(2, wheel=0.0)
    yield status_row(3, "/navigate_to_pose", (1, 2, 2), (9, -5000, 4))
    for step in range(101):
        yield tf_row(10 + step * 20, ("odom", "base_footprint", (step / 100, 0.0, 0.0), 0.0))
        yield joints_row(15 + step * 20, wheel=step / 10)
    yield log_row(2100, 10, "debug")
    yield log_row(2101, 30, "slow")
    yield text_row(2102, "/battery", "low")
    yield text_row(2103, "/chatter", "hello")
    yield status_row(2104, "/navigate_to_pose", (1, 2, 4))
    yield status_row(2105, "/navigate_to_pose", (1, 2, 4), (2, 2105, 1))
    yield status_row(2110, "/navigate_to_pose", (2, 2105, 6))
    yield status_row(2111, "/wave_arm", (3, 2111, 2))


MAP = """
description = "a drive"
[actions]
"/navigate_to_pose" = "NavigateAction"
[observations]
"/battery" = "battery"
[object_types]
milk = "MILK"
"""


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_becomes_poses_joints_actions_and_observations(tmp_path: Path, plugin: StoragePlugin) -> None:
    (tmp_path / "map.toml").write_text(MAP)
    folder = bag(tmp_path / "drive", a_drive(), plugin)
    report = imported(tmp_path, "rosbag2", folder, map_file=tmp_path / "map.toml")
    us = AT // 1000
    assert tree(tmp_path / "memory.db") == [
        ("NavigateAction", None, "action", "SUCCEEDED", None, None, us + 2000, us + 2_104_000),
        (
            "NavigateAction", None, "action", "FAILED", "the action server aborted the goal",
            "the action server aborted the goal", us + 2_105_000, us + 2_110_000,
        ),
        ("WaveArm", None, "action", "UNKNOWN", None, None, us + 2_111_000, None),
    ]  # fmt: skip
    states = poses(tmp_path / "memory.db")
    first = {name: (kind, *numbers) for name, kind, *numbers in reversed(states)}
    last = {name: numbers for name, _, *numbers in states}
    assert {name: kind for name, (kind, *_) in first.items()} == {"robot": "ROBOT", "milk": "MILK", "table": "UNKNOWN"}
    assert last["robot"][:3] == pytest.approx([10, 1, 0], abs=1e-9)
    assert last["robot"][3:] == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
    assert last["milk"][:3] == pytest.approx([3, 0.25, 1])
    assert 20 <= sum(name == "robot" for name, *_ in states) <= 22  # at 10 Hz, of 50
    assert report.episodes[0].samples == 102
    observed = ask(
        tmp_path / "memory.db", "SELECT name, \"values\" FROM observation WHERE name IN ('rosout', 'battery')"
    )
    assert sorted(name for name, _ in observed) == ["battery", "rosout"]
    left_out = {what: (count, why) for (what, why), count in report.left_out.items()}
    assert {what: count for what, (count, _) in left_out.items()} == {
        "messages of /chatter": 1,
        "lines of rosout": 1,
        "goals of actions": 1,
        "frames of links of the robot": 2,
        "frames": 1,
    }
    assert "does not reach the frame map" in left_out["frames"][1]


def in_small_chunks(source: Path, target: Path) -> bytes:
    """Write the messages of an MCAP file again, in chunks of a few messages each; return its bytes."""
    with source.open("rb") as read, target.open("wb") as written:
        writer = mcap.writer.Writer(written, chunk_size=2_000)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, each in mcap.reader.make_reader(read).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], each.log_time, each.data, each.publish_time)
        writer.finish()
    return target.read_bytes()


def test_an_mcap_file_that_is_cut_anywhere_gives_what_stands_before_and_says_where(tmp_path: Path) -> None:
    [file] = bag(tmp_path / "drive", a_drive()).glob("*.mcap")
    content = in_small_chunks(file, tmp_path / "small.mcap")
    changes: list[int] = []
    for tenths in (0, 2, 4, 6):
        (tmp_path / "bag.mcap").write_bytes(content[: 40 + len(content) * tenths // 10])
        report = registry.import_files("mcap", [tmp_path / "bag.mcap"], None)
        [line] = report.cut
        assert "bag.mcap cannot be read behind byte" in line
        changes.append(sum(each.changes for each in report.episodes))
    assert changes[0] == 0
    assert sorted(set(changes)) == changes


def test_definitions_of_the_file_decode_goals_and_unknown_types_are_counted(tmp_path: Path) -> None:
    import numpy as np

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in NAVIGATE.items():
        store.register(get_types_from_msg(text, name))
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    goal = store.types["nav/msg/Goal"](
        pose=message("geometry_msgs/msg/PoseStamped", header=header("map"), pose=pose), behavior_tree="tree"
    )
    event = store.types["nav/msg/Navigate_SendGoal_Event"](
        info=message(
            "service_msgs/msg/ServiceEventInfo",
            event_type=1, stamp=time_of(AT), client_gid=np.zeros(16, np.uint8), sequence_number=1,
        ),
        request=[store.types["nav/msg/Navigate_SendGoal_Request"](goal_id=goal_id(1), goal=goal)],
        response=[],
    )  # fmt: skip
    rows: list[Row] = [
        (AT, "/go/_action/send_goal/_service_event", "nav/msg/Navigate_SendGoal_Event", event),
        status_row(5, "/go", (1, 5, 2)),
        status_row(7, "/go", (1, 5, 5)),
        (AT + 8 * MS, "/tf", "tf2_msgs/msg/TFMessage", b"\0\1\0\0\xff\xff\xff\xff"),
        (AT + 9 * MS, "/broken/_action/status", "action_msgs/msg/GoalStatusArray", b"\0\1\0\0\5"),
    ]
    report = imported(tmp_path, "mcap", bag(tmp_path / "b", rows, store=store))
    [row] = tree(tmp_path / "memory.db")
    assert row[:4] == ("Go", None, "action", "CANCELLED")
    [target] = ask(
        tmp_path / "memory.db",
        "SELECT pose.x, pose.y, go.behavior_tree FROM go JOIN pose ON pose.id = go.pose_id",
    )
    assert target == (1.0, 2.0, "tree")
    assert dict(iter(report.left_out)) == {
        "messages of /tf": "they cannot be decoded as tf2_msgs/msg/TFMessage",
        "messages of /broken/_action/status": "they cannot be decoded as action_msgs/msg/GoalStatusArray",
    }


def test_the_files_of_a_bag_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    for number in (0, 2, 10):
        row = tf_row(number * 1000, ("map", "cup", (float(number), 0.0, 0.0), 0.0))
        [file] = bag(tmp_path / f"part{number}", [row]).glob("*.mcap")
        file.rename(tmp_path / "bag" / f"bag_{number}.mcap")
    imported(tmp_path, "rosbag2", tmp_path / "bag")
    assert [x for _, _, x, *_ in poses(tmp_path / "memory.db")] == [0, 2, 10]


def test_messages_in_another_encoding_are_counted_whatever_their_topic_is(tmp_path: Path) -> None:
    with (tmp_path / "foxglove.mcap").open("wb") as written:
        writer = mcap.writer.Writer(written)
        writer.start()
        schema = writer.register_schema("tf2_msgs/msg/TFMessage", "jsonschema", b"{}")
        channel = writer.register_channel("/tf", "json", schema)
        writer.add_message(channel, AT, b"{}", AT)
        writer.finish()
    report = imported(tmp_path, "mcap", tmp_path / "foxglove.mcap")
    assert report.left_out == {("messages of /tf", "they are none of ROS 2"): 1}


def test_frames_in_a_circle_and_times_that_go_back_end_no_import(tmp_path: Path) -> None:
    rows = [
        tf_row(0, ("a", "b", (1.0, 0.0, 0.0), 0.0), ("b", "a", (1.0, 0.0, 0.0), 0.0)),
        tf_row(1000, ("map", "cup", (1.0, 0.0, 0.0), 0.0)),
        tf_row(-3_600_000, ("map", "cup", (2.0, 0.0, 0.0), 0.0)),
        tf_row(-3_599_000, ("map", "'; DROP TABLE event; --\x1b", (3.0, 0.0, math.nan), 0.0)),
    ]
    folder, later = bag(tmp_path / "b", rows[:2]), bag(tmp_path / "later", rows[2:])
    next(later.glob("*.mcap")).rename(folder / "later.mcap")
    report = imported(tmp_path, "mcap", folder, faults=1)  # the first time that goes back
    assert [(name, x) for name, _, x, *_ in poses(tmp_path / "memory.db")] == [("cup", 1.0), ("cup", 2.0)]
    assert report.episodes[0].objects == 1


def test_messages_of_a_chunk_that_were_written_late_come_at_their_times(tmp_path: Path) -> None:
    poses_first = [tf_row(ms, ("map", "base_link", (ms / 1000, 0.0, 0.0), 0.0)) for ms in range(0, 10_000, 100)]
    rows = [*poses_first, status_row(1_000, "/go", (1, 1_000, 2)), status_row(4_000, "/go", (1, 1_000, 4))]
    imported(tmp_path, "mcap", bag(tmp_path / "b", rows))
    question = "SELECT start_time, end_time FROM task_tree_node WHERE dtype = 'Go'"
    assert ask(tmp_path / "memory.db", question) == [((AT + 1_000 * MS) // 1000, (AT + 4_000 * MS) // 1000)]


def test_the_map_file_of_the_page_has_keys_of_this_format(tmp_path: Path) -> None:
    page = (Path(registry.__file__).parent / "README.md").read_text()
    [block] = [each for each in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "tiago" in each]
    (tmp_path / "map.toml").write_text(block)
    settings = registry.read_map_file(tmp_path / "map.toml", RosMap)
    assert isinstance(settings, RosMap)
    assert (settings.robot, settings.objects["tag_7"], settings.images["/camera/image/compressed"]) == (
        "tiago",
        "milk",
        0.5,
    )


def test_images_come_at_their_rate_as_blobs(tmp_path: Path) -> None:
    import numpy as np

    def image(ms: int) -> Row:
        content = message(
            "sensor_msgs/msg/CompressedImage", header=header("camera"), format="jpeg", data=np.arange(9, dtype=np.uint8)
        )
        return AT + ms * MS, "/camera/compressed", "sensor_msgs/msg/CompressedImage", content

    (tmp_path / "map.toml").write_text('[images]\n"/camera/compressed" = 2\n')
    folder = bag(tmp_path / "b", map(image, range(0, 2000, 100)))
    report = imported(tmp_path, "mcap", folder, map_file=tmp_path / "map.toml")
    assert report.episodes[0].observations == 4
    assert report.left_out["messages of /camera/compressed", "more than 2 in a second"] == 16
    assert ask(tmp_path / "memory.db", "SELECT count(*) FROM pycrorm_blob") == [(1,)]


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda file: file.write_bytes(b"#ROSBAG V2.0\n"), "convert it with `rosbags-convert`"),
        (lambda file: file.write_bytes(b"SQLite format 3\0" + bytes(90)), "is no .db3 file of rosbag2"),
        (lambda file: file.write_bytes(b""), "is neither an MCAP file nor a .db3 file of rosbag2"),
        (lambda file: file.mkdir(), "has no .mcap or .db3 file"),
    ],
)
def test_another_file_is_one_line(tmp_path: Path, make: Callable[[Path], object], line: str) -> None:
    make(tmp_path / "x.bag")
    with pytest.raises(CallerError, match=re.escape(line)) as refused:
        registry.import_files("rosbag2", [tmp_path / "x.bag"], None)
    assert "\n" not in str(refused.value)
