"""Move records from a queue into a log in the background; the writer knows both only as `ports`.

`drain` is the loop read, append, acknowledge. `background_writer` decides when to fold and drains dead recorders;
`writer_thread` runs it beside a plan. `daemon` drains all recorders of a spool in its own process, `drain_once` drains
and folds once. After a lost reply, a kill or with a second writer a batch may arrive twice, and the log stores it once;
no batch is lost.
"""
