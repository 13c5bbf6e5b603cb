"""Who saw it: what plans and worlds tell becomes events, with the values of the moment, in the queue."""
