"""Where it lives: the append-only event log in a database, the only truth; every other table can be made from it.

    event(episode, sequence, type, version, wall_ns, monotonic_ns, payload)      one row an event, payload as JSON text
    episode(number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked)
    pycrorm_declaration(ordinal, fingerprint, payload)                           designator types, in order of arrival
    pycrorm_log(id, format, created_wall_ns)                                     one row: which log this is

`number` is given to an episode at its first append, belongs to this database and is never used again. `head` is the
last sequence stored: one recorder writes an episode and nothing is stored beyond a gap, so events 1 to `head` are all
there. `folded` is how far the tables follow. `ended_wall_ns` is null while no EpisodeEnded is stored. `refused` says
why the log took no more of this episode, `parked` why the tables take no more; both are null as a rule.

An episode may be refused and still be folded up to its head, or parked and still grow: a fault in a table must not
stop the log. A refusal ends by itself when the missing records arrive; a parked episode is released by a rebuild.

`address` names a database, `schema` makes and recognises one, `batch` decides what becomes of a batch, `append` does
it, `log` is what others call, `progress` is what a projector adds to its own transaction; everything only SQLite
understands is in `sqlite`.
"""
