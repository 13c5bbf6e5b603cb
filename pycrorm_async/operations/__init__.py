"""Run the daemon, recovery, rebuild and copy, one module for each operation that an operator starts.

Like `memory.py`, it joins a queue to a database; the packages of both ends do not know each other.
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.operations.copy import tag_episode as tag_episode
    from pycrorm_async.operations.destination import expected_log as expected_log
    from pycrorm_async.operations.destination import open_destination as open_destination
    from pycrorm_async.operations.rebuild import rebuild_outdated as rebuild_outdated
    from pycrorm_async.operations.recovery import dead_queues as dead_queues
    from pycrorm_async.operations.stored_episodes import LogEpisodes as LogEpisodes
    from pycrorm_async.operations.writer_process import WriterAssignment as WriterAssignment
    from pycrorm_async.operations.writer_process import WriterProcess as WriterProcess
    from pycrorm_async.operations.writer_process import WriterProcessState as WriterProcessState

__getattr__ = lazy_names(
    __name__,
    {
        "copy": "tag_episode",
        "destination": "expected_log open_destination",
        "rebuild": "rebuild_outdated",
        "recovery": "dead_queues",
        "stored_episodes": "LogEpisodes",
        "writer_process": "WriterAssignment WriterProcess WriterProcessState",
    },
)
