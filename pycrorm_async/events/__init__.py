"""What happened: frozen values, their envelope, their ids, their bytes. Pure: no I/O, no clock, no loop."""
