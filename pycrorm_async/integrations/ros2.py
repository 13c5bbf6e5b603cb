"""Record what a running system of ROS 2 publishes: `python -m pycrorm_async.integrations.ros2 --map FILE.toml`.

The node subscribes to what the map file names and to what `imports.ros_messages` reads by itself (transforms, joint
states, actions, rosout), also to topics that appear later, and records it as one episode until Ctrl-C. The map file is
that of `pycrorm import mcap`, so that a bag and the live system give the same episode. `rclpy` is that of the sourced
ROS installation, and is imported only when the node starts.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Self

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import MissingExtra, PycrormError
from pycrorm_async.imports.intake import Intake, IntakeEpisode
from pycrorm_async.imports.registry import read_map_file
from pycrorm_async.imports.ros_messages import RosMap, RosReader
from pycrorm_async.memory import Memory
from pycrorm_async.record.recording import Recording
from pycrorm_async.settings import Settings

_DISCOVERY_S: Final = 1.0
"""The seconds between two looks for new topics."""
_DEPTH: Final = 100
"""The messages of a topic that wait while another one is recorded."""


class RosRecording:
    """Records the messages of a node of ROS; use it with `with`, which is one episode.

    Args:
        node: an `rclpy` node.
        message_class: returns the class of a message by name, such as `rosidl_runtime_py.utilities.get_message`.
        quality: returns the quality of service of a subscription for those of a topic's publishers.
        now_ns: the time of a message's receipt, in ns since 1970.

    Attributes:
        intake: has the report of what was recorded and what was left out.
    """

    def __init__(
        self,
        node: Any,
        settings: RosMap,
        recording: Recording,
        message_class: Callable[[str], Any],
        quality: Callable[[list[Any]], Any],
        *,
        now_ns: Callable[[], int] = SYSTEM_CLOCK.wall_ns,
    ) -> None:
        self.intake = Intake("ros2", settings, recording)
        self._node = node
        self._settings = settings
        self._message_class, self._quality, self._now_ns = message_class, quality, now_ns
        self._topics: set[str] = set()

    def __enter__(self) -> Self:
        metadata = {"node": self._node.get_name()}
        self._episode: IntakeEpisode = self.intake.episode(
            "", self._now_ns(), description="a system of ROS 2", metadata=metadata
        )
        self._reader = RosReader(self._settings, self._episode, self.intake)
        self.discover()
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.finish()
        self._episode.ended("UNKNOWN", self._now_ns())
        self._episode.__exit__(None, None, None)

    def discover(self) -> None:
        """Subscribe to the topics that are new and wanted; a topic whose type cannot be imported is counted."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._topics or not types:
                continue
            self._topics.add(topic)
            if not self._reader.wants(topic, types[0]):
                self.intake.left_out("topics", f"{types[0]} is recorded if `observations` names its topic")
                continue
            try:
                kind = self._message_class(types[0])
            except (ImportError, AttributeError, ValueError, LookupError) as error:
                self.intake.left_out(f"the topic {topic}", f"its type {types[0]} cannot be imported: {error}")
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            quality = self._quality([each.qos_profile for each in publishers])
            self._node.create_subscription(kind, topic, self._callback(topic, types[0]), quality)

    def _callback(self, topic: str, type_name: str) -> Callable[[Any], None]:
        def read(message: Any) -> None:
            at = self._now_ns()
            try:
                if self._reader.is_due(topic, type_name, at):
                    self._reader.read(topic, type_name, message, at)
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                self.intake.left_out(f"messages of {topic}", f"they are not as expected: {error}")

        return read


def compatible_quality(qos: Any, publishers: list[Any]) -> Any:
    """Return a quality of service that fits all publishers; `qos` is the module `rclpy.qos`.

    What only some of them offer must not be asked for: a best-effort publisher sends nothing to a reliable subscriber.
    Latched topics (`/tf_static`, the status of an action) are transient local.
    """
    reliable, latched = qos.ReliabilityPolicy.RELIABLE, qos.DurabilityPolicy.TRANSIENT_LOCAL
    is_reliable = all(each.reliability == reliable for each in publishers)
    is_latched = bool(publishers) and all(each.durability == latched for each in publishers)
    return qos.QoSProfile(
        depth=_DEPTH,
        reliability=reliable if is_reliable else qos.ReliabilityPolicy.BEST_EFFORT,
        durability=latched if is_latched else qos.DurabilityPolicy.VOLATILE,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the node until Ctrl-C or the shutdown of ROS; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pycrorm_async.integrations.ros2", description=__doc__)
    parser.add_argument("--map", metavar="FILE.toml", type=Path, help="the keys of `pycrorm import mcap`")
    parser.add_argument("--url", default="sqlite:///pycrorm.db", help="the database; default: %(default)s")
    parser.add_argument("--node", default="pycrorm", help="the name of the node; default: %(default)s")
    options = parser.parse_args(arguments)
    try:
        settings = read_map_file(options.map, RosMap)
        assert isinstance(settings, RosMap)
        _run(settings, options.url, options.node)
    except PycrormError as error:
        sys.stderr.write(f"pycrorm: {error}\n")
        return 2
    return 0


def _run(settings: RosMap, url: str, name: str) -> None:
    try:
        import rclpy
        from rclpy import qos
        from rclpy.executors import ExternalShutdownException
        from rosidl_runtime_py.utilities import get_message
    except ImportError as error:
        hint = "source the setup.bash of a ROS 2 installation, with its Python"
        raise MissingExtra(f"rclpy cannot be imported ({error}): {hint}") from None
    rclpy.init()
    node = rclpy.create_node(name)
    with Memory.sync(url, settings=Settings(fold="at_end")) as memory:
        recorder = RosRecording(
            node, settings, memory.recording, get_message, lambda publishers: compatible_quality(qos, publishers)
        )
        with recorder:
            node.create_timer(_DISCOVERY_S, recorder.discover)
            try:
                rclpy.spin(node)
            except (KeyboardInterrupt, ExternalShutdownException):
                node.destroy_node()
    for (what, why), count in recorder.intake.report.left_out.most_common():
        sys.stderr.write(f"left out: {count:,} {what}: {why}\n")


if __name__ == "__main__":
    sys.exit(main())
