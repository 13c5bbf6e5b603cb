"""`python -m pycrorm_async` runs the command `pycrorm`."""

from pycrorm_async.cli.main import main

if __name__ == "__main__":
    main()
