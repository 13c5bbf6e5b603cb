"""Serve episodes on this machine while they are recorded: the page of the report, and a list of all robots' activities.

`follower` reads new events from the log, `activity` and `overview` fold the present activities, `server` sends both to
browsers, and `access` refuses requests that are not from the page itself. `cli/watch` draws in a terminal.
"""
