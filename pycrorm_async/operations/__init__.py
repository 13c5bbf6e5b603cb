"""Run what an operator starts: the daemon, recovery, rebuild and copy.

Together with `memory.py` this is the only package that sees both a queue and a database.
"""
