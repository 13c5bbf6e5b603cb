"""Run blocks of Python in order as the cells of a notebook: `python -m tests.promises.cells`.

Each line on stdin names three files: the block, and those that get its stdout and stderr. The line `done` answers it.
The first block that raises ends the process with its traceback. The blocks share their names and one event loop, which
runs the tasks that they started also between them.
"""

import ast
import asyncio
import os
import sys
import traceback
from pathlib import Path


async def main() -> None:
    names: dict[str, object] = {"__name__": "__main__"}
    sys.path.insert(0, "")
    with os.fdopen(os.dup(1), "w") as answers:
        while line := await asyncio.to_thread(sys.stdin.readline):
            block, *outputs = line.split()
            for path, stream in zip(outputs, (1, 2), strict=True):
                file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
                os.dup2(file, stream)
                os.close(file)
            if not await ran(block, names):
                sys.exit(1)
            print("done", file=answers, flush=True)


async def ran(block: str, names: dict[str, object]) -> bool:
    """Return whether a block ran to its end; print the traceback otherwise."""
    try:
        code = compile(Path(block).read_text(), block, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        running = eval(code, names)  # a coroutine if the block awaits
        if running is not None:
            await running
    except Exception:  # noqa: BLE001  as a notebook shows it
        traceback.print_exc()
        return False
    finally:
        sys.stdout.flush()
    return True


if __name__ == "__main__":
    asyncio.run(main())
