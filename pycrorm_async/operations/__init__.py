"""Run the daemon, recovery, rebuild and copy, one module for each operation that an operator starts.

Like `memory.py`, it joins a queue to a database; the packages of both ends do not know each other.
"""
