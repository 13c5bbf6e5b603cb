"""`pycrorm` and `python -m pycrorm_async` run the command; an interruption while it is being loaded is one line too."""

import sys


def main() -> None:
    """Run the command."""
    try:
        from pycrorm_async.cli.main import main as run_command
    except KeyboardInterrupt:
        sys.stderr.write("pycrorm: interrupted before the command started\n")
        sys.exit(130)
    run_command()


if __name__ == "__main__":
    main()
