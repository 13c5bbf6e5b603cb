"""The hooks turn what a plan and its world report into events, with copies of the values, and put them in the queue."""
