"""How it travels: the background writer moves records from a queue into a log, knowing both only as `ports`.

`drain` is the loop read, append, acknowledge; `live` adds when to fold and whom to adopt; `thread` runs that beside a
plan; `once` does all there is and returns. A lost reply, a kill or a second writer make a batch arrive twice, never not
at all: the log stores it once.
"""
