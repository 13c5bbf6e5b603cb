"""Serve episodes on this machine while they are recorded: the page of the report, and a list of all robots' activities.

`server` reads new events from the log, folds the present activities, sends both to browsers, and refuses requests that
are not from the page itself. `cli/watch` draws in a terminal.
"""
