"""Define event types, envelopes, ids and the codec, without I/O, clock or event loop."""
