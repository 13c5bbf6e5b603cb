"""Compile `_core.c` when the package is installed; without a compiler it installs all the same, and runs slower.

Hatchling runs the hook for each wheel, also for that of an editable install, which gets the library beside its source.
`python pycrorm_async/core/build.py` compiles it there again after a change of the C file.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_SOURCE = "pycrorm_async/core/_core.c"
_LIBRARY = "pycrorm_async/core/_core.abi3.so"
FLAGS = ("-O2", "-std=c11", "-shared", "-fPIC", "-fvisibility=hidden", "-Wall", "-Wextra", "-Wconversion")


class NotCompiled(Exception):
    """The compiled core cannot be built here; the message is the reason."""


class CompiledCore(BuildHookInterface[Any]):
    """Adds the compiled core to a wheel if it can be built."""

    PLUGIN_NAME = "custom"
    _folder: tempfile.TemporaryDirectory[str] | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and mark the wheel as one of this platform."""
        is_editable = version == "editable"
        self._folder = tempfile.TemporaryDirectory()
        library = Path(self.root, _LIBRARY) if is_editable else Path(self._folder.name, "_core.abi3.so")
        try:
            compile_core(Path(self.root, _SOURCE), library)
        except NotCompiled as reason:
            if is_editable:
                library.unlink(missing_ok=True)  # of an earlier installation
            self.app.display_warning(f"the queue is not compiled, so recording takes longer: {reason}")
            return
        if not is_editable:
            build_data["force_include"][str(library)] = _LIBRARY
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"] = False
        build_data["tag"] = f"cp311-abi3-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:  # noqa: ARG002
        """Delete the library, which is in the wheel now."""
        if self._folder is not None:
            self._folder.cleanup()


def compile_core(source: Path, library: Path, *flags: str) -> None:
    """Compile with the compiler of `CC`, else that of this Python, else any; `CFLAGS` and `flags` come last.

    Replaces the library in one step, because running processes may have it loaded. Raises `NotCompiled`.
    """
    if os.environ.get("PYCRORM_PURE", "0") not in ("", "0"):
        raise NotCompiled("PYCRORM_PURE is set")
    if sys.platform != "linux" or sys.implementation.name != "cpython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
        raise NotCompiled("only CPython on Linux, with the interpreter lock, can use it")
    own = os.environ.get("CC")
    compilers = [own] if own else [sysconfig.get_config_var("CC") or "cc", "cc", "gcc", "clang"]
    unfinished = library.with_name(f"{library.name}.{os.getpid()}")
    include = f"-I{sysconfig.get_path('include')}"
    digest = f'-DSOURCE="{sha256(source.read_bytes()).hexdigest()}"'
    more = (*os.environ.get("CFLAGS", "").split(), *flags)
    for compiler in compilers:
        command = [*compiler.split(), *FLAGS, include, digest, *more, str(source), "-o", str(unfinished)]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603  # the compiler
        except OSError as error:
            reason = f"{command[0]}: {error.strerror}"
        except subprocess.CalledProcessError as error:
            unfinished.unlink(missing_ok=True)
            lines = [each for each in error.stderr.splitlines() if "error" in each] or error.stderr.splitlines()
            raise NotCompiled(lines[0] if lines else f"{command[0]} exited with status {error.returncode}") from None
        else:
            unfinished.replace(library)
            return
    raise NotCompiled(f"there is no C compiler ({reason})")


if __name__ == "__main__":
    folder = Path(__file__).parent
    try:
        compile_core(folder / "_core.c", folder / "_core.abi3.so", *sys.argv[1:])
    except NotCompiled as reason:
        sys.exit(f"not compiled: {reason}")
