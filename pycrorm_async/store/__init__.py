"""Store the append-only event log in a database; every other table can be made from it.

    event(episode, sequence, type, version, wall_ns, monotonic_ns, payload)      one row an event, payload as JSON text
    episode(number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked)
    pycrorm_declaration(ordinal, fingerprint, payload)     designator types and descriptions, in order of arrival
    pycrorm_log(id, format, created_wall_ns)                                     one row: the log's identity

An episode gets its `number` at its first append; the number belongs to this database and is never used again. `head` is
the last stored sequence: one recorder writes an episode, and the log stores no event beyond a gap, so events 1 to
`head` are all stored. `folded` is the last sequence visible in the tables. `ended_wall_ns` is null until an
EpisodeEnded is stored. `refused` is the reason why the log refused events of this episode, `parked` the reason why
folding it stopped; both are normally null.

A refused episode is still folded up to its head, and a parked episode still grows, because a fault in a table must not
stop the log. A refusal ends when the missing records arrive; a rebuild releases a parked episode.

`address` parses URLs, `schema` defines the tables and statements, `append` decides about a batch and writes it, `log`
creates and recognises logs and is the interface for other packages. `dialect` defines the differences between
databases; `sqlite` and `postgresql` implement it.
"""
