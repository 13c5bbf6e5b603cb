"""Serve episodes on this machine while they are recorded: the page of the report, and a list of all robots' activities.

`follower` reads new events from the log and folds the present activities, `server` sends both to browsers, and `access`
refuses requests that are not from the page itself. `cli/watch` draws in a terminal, without `server` and its extra.
"""
