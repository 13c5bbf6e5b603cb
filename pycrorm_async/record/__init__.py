"""Any executive writes episodes through this package, also our own plan layer.

`Recording` is the way in. It declares types (`declarations`) and opens episodes (`opening`). An `EpisodeWriter` writes
what an episode consists of: its beginning and end, the starts and ends of its nodes, percepts, tags and observations.
`ObjectRows` keeps the rows of its objects, and `values` reads live values.

`RecordedEpisode` takes keys and values of any executive, from any thread, and copies and converts them. Its writer, a
`KeyedEpisode`, runs the calls of all episodes one after the other, knows nodes and objects by their keys, and keeps the
last state of each object, because an executive cannot be asked for it again.

`plan_recorder`, `plan_types` and `geometry` are the adapters of our own plan layer and world: the hooks read live
designators, and a world that reports its changes in the plan's own thread, so they copy nothing twice and take no lock.
The other modules know neither a plan nor a world: a class of poses, objects or failures says so by an attribute
(`__recorded_as__`, `__is_plan_failure__`).
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.record.plan_recorder import Episode as Episode
    from pycrorm_async.record.plan_recorder import Recorder as Recorder
    from pycrorm_async.record.plan_types import built_in_declaration as built_in_declaration

__getattr__ = lazy_names(__name__, {"plan_recorder": "Episode Recorder", "plan_types": "built_in_declaration"})
