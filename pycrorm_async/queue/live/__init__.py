"""Put events into the queue of a running recorder, and sync its files."""
