"""Run the daemon, recovery, rebuild and copy, one module for each operation that an operator starts.

Together with `memory.py` this is the only package that sees both a queue and a database.
"""
