"""The hooks turn reports of a plan and its world into events, with copies of the values, and put them in the queue."""
