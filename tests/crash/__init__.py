"""Faults that could make the system lose, double or reorder an event, and the tests that inject them.

The soak runs more and longer rounds (`python -m pytest -m soak tests/crash`), some on real disks. Random choices
follow from a seed that is printed, and that PYCRORM_TEST_SEED sets.

 1  SIGKILL at any moment
        test_killed (12 recorders, 10,000 in the soak), test_daemon, test_many_machines
 2  killed at each step that touches disk or log, and once more
        test_crash_points; queue/test_dead_source (sealing, removing), queue/test_maintenance
 3  power cut: any sectors of what was not synced
        test_disk; everything that was not synced, of the whole memory: test_forgetful_disk; a mounted image of a disk:
        test_real_disks
 4  torn write at every byte
        queue/test_dead_source, queue/test_format, queue/test_drain_notes
 5  every bit flipped
        queue/test_dead_source, queue/test_format; queue/test_maintenance (any byte changed)
 6  an older record on the same blocks; segments are never reused
        queue/test_dead_source
 7  a sync that fails
        test_disk, queue/test_dead_source (a disk that fails while a dead recorder's records are made durable)
 7b each system call of queue, writer and SQLite fails once
        test_failing_calls
 8  a full disk, below the queue and below the database
        test_disk, test_real_disks (ext4 and XFS), store/test_full_disk, cli/test_bad_input
 9  a COMMIT whose reply is lost
        store/test_postgresql_faults, writer/test_drain, writer/test_writer_thread
10  a database stopped or killed under load, a failover, a network that cuts, stalls, resets, dribbles
        test_many_machines, test_daemon, test_failover, store/test_postgresql_faults
11  commits out of order, gaps
        store/test_postgresql_concurrency (an earlier number is committed later), store/test_append
12  a writer that is suspended, a second writer
        queue/test_locks_and_forks, queue/test_live_source, cli/test_writer
13  a projection killed, several at once, an event that cannot be folded
        test_daemon, test_cancelled, projections/test_projector (parked once, visible once),
        memory/test_delegated_writer
14  cancelled at every await, fork, exit with a full queue, a requested stop
        test_cancelled, queue/test_locks_and_forks, test_killed, test_daemon
15  a plan faster than its writer, clocks set back
        queue/test_full_spool, memory/test_delegated_writer (a full spool), test_killed
16  several of them at random
        test_simulation

A pipe that outlives the process keeps what was acknowledged.
"""
