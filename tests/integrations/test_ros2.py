"""The live node of ROS 2, with the messages of rosbags and a fake node: no ROS is installed where the tests run."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rosbags")
from pycrorm_async import Memory
from pycrorm_async.imports.ros_messages import RosMap
from pycrorm_async.integrations.ros2 import RosRecording, compatible_quality
from tests.commands import environment
from tests.databases import ask, put_memory
from tests.imports import test_bags as bags
from tests.imports.importing import imported, poses, tree

MS = 1_000_000


class FakeNode:
    """A node whose topics are those of a list, and whose messages the test gives."""

    def __init__(self, topics: dict[str, str]) -> None:
        self.topics = topics
        self.callbacks: dict[str, Callable[[Any], None]] = {}

    def get_name(self) -> str:
        return "pycrorm"

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(topic, [kind]) for topic, kind in self.topics.items()]

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [SimpleNamespace(qos_profile=topic)]

    def create_subscription(self, kind: Any, topic: str, callback: Callable[[Any], None], quality: Any) -> None:
        assert kind is bags.STORE.types[self.topics[topic]]
        assert quality == [topic]
        self.callbacks[topic] = callback


def test_a_live_system_gives_the_episode_that_its_bag_gives(tmp_path: Path) -> None:
    rows = list(bags.a_drive())
    url, now = put_memory(tmp_path / "live.db"), [bags.AT]
    node = FakeNode({topic: kind for _, topic, kind, _ in rows if topic != "/navigate_to_pose/_action/status"})
    node.topics["/strange"] = "not_there/msg/Strange"
    node.topics["/scan"] = "sensor_msgs/msg/LaserScan"
    settings = RosMap(observations={"/battery": "battery", "/strange": "strange"}, object_types={"milk": "MILK"})
    with Memory.sync(url) as memory:
        recorder = RosRecording(
            node, settings, memory.recording, bags.STORE.types.__getitem__, lambda each: each, now_ns=lambda: now[0]
        )
        with recorder:
            for at, topic, kind, message in rows:
                now[0] = at
                if topic not in node.topics:  # the action server starts later
                    node.topics[topic] = kind
                    recorder.discover()
                if topic in node.callbacks:
                    node.callbacks[topic](message)
        memory.flush()
        assert memory.status.faults.total == memory.status.missing.total == 0
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "map.toml").write_text(
        '[observations]\n"/battery" = "battery"\n[object_types]\nmilk = "MILK"\n'
    )
    imported(tmp_path, "mcap", bags.bag(tmp_path / "b", rows), map_file=tmp_path / "bag" / "map.toml")
    assert tree(tmp_path / "live.db") == tree(tmp_path / "memory.db")
    assert poses(tmp_path / "live.db") == poses(tmp_path / "memory.db")
    assert len(poses(tmp_path / "live.db")) > 20
    names = "SELECT name, count(*) FROM observation GROUP BY name ORDER BY name"
    assert ask(tmp_path / "live.db", names) == ask(tmp_path / "memory.db", names)
    left_out = {what for what, _ in recorder.intake.report.left_out}
    assert {"topics", "the topic /strange"} <= left_out
    assert ask(tmp_path / "live.db", "SELECT status FROM process_metadata") == [("UNKNOWN",)]


def test_a_message_that_is_not_as_its_type_is_counted_and_the_next_one_is_recorded(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "live.db")
    node = FakeNode({"/rosout": "rcl_interfaces/msg/Log"})
    with Memory.sync(url) as memory:
        recorder = RosRecording(
            node, RosMap(), memory.recording, bags.STORE.types.__getitem__, lambda each: each, now_ns=lambda: bags.AT
        )
        with recorder:
            node.callbacks["/rosout"](SimpleNamespace(level="no number"))
            node.callbacks["/rosout"](bags.log_row(0, 30, "slow")[3])
        memory.flush()
    assert [what for what, _ in recorder.intake.report.left_out] == ["messages of /rosout"]
    assert ask(tmp_path / "live.db", "SELECT name FROM observation") == [("rosout",)]


@pytest.mark.parametrize(
    ("publishers", "expected"),
    [
        ([("reliable", "volatile")], ("reliable", "volatile")),
        ([("reliable", "latched"), ("reliable", "latched")], ("reliable", "latched")),
        ([("reliable", "latched"), ("best effort", "volatile")], ("best effort", "volatile")),
        ([], ("reliable", "volatile")),
    ],
)
def test_a_subscription_asks_for_what_all_publishers_offer(
    publishers: list[tuple[str, str]], expected: tuple[str, str]
) -> None:
    qos = SimpleNamespace(
        ReliabilityPolicy=SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile"),
        QoSProfile=lambda **fields: (fields["reliability"], fields["durability"]),
    )
    profiles = [SimpleNamespace(reliability=each, durability=other) for each, other in publishers]
    assert compatible_quality(qos, profiles) == expected


def test_without_ros_the_node_says_so_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pycrorm_async.integrations.ros2"]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("pycrorm: rclpy cannot be imported")
    assert "Traceback" not in done.stderr
    assert [*tmp_path.iterdir()] == []
