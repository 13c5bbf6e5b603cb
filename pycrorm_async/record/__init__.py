"""Any executive writes episodes through this package, also our own plan layer.

Both write by the same code what an episode consists of: its beginning and end, the starts and ends of its
nodes, its percepts and tags (`EpisodeWriter`), the rows of its objects, their joints and attachments (`ObjectRows`),
observations (`put_observation`), the values inside these (`values`), the checks of declared types (`KnownTypes`), and
the queue (`Emitter`, `OpenEpisodes`).

What comes before that differs, because the sources do. The hooks of our own plan layer (`plan_recorder`, `episode`)
read live designators and a world that reports its changes in the plan's own thread and context, so they build
ObjectAdded and ObjectMoved from its objects and a declaration from the annotations of a class, copy nothing twice and
take no lock. `Recording` and `RecordedEpisode` get keys and values from any thread: they copy and convert these first,
keep the last state of each object, because they cannot ask for it again, build a declaration from the names of fields,
and run the calls of an episode one after the other. One function for both would make a hook pay for the copies and the
lock.
"""
