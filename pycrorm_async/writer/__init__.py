"""Move records from a queue into a log in the background; the writer knows both only as ports.

`drain` has the ports and the loop read, append, acknowledge; its `drain_once` drains and folds once. `plan_writer`
decides when to fold, drains dead recorders, and runs in a thread beside a plan. `daemon` drains all recorders of a
spool in its own process. After a lost reply, a kill or with a second writer a batch may arrive twice, and the log
stores it once; no batch is lost.
"""
