"""What it means: the log's events folded into tables that people ask.

    log ──▶ fold ──▶ rows ──▶ projector ──▶ tables of a generation ──▶ public views ──▶ orm, query

`tables` lists the tables, `layout` what designator types add to them, `public` the views in front of them, `views`
those that users register. `fold` is pure: events in, rows out. `generations` makes the tables, `projector` fills them:
rows and progress in one transaction. Everything here can be thrown away and made again from the log.

A table `pose` is stored as `pose__1`, in generation 1; `pose` itself is a view. A rebuild fills `pose__2` beside it and
then only the views change.
"""
