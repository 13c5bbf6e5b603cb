"""Write the events of episodes into the queue."""
