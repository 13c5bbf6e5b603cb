"""Execute notebooks in a kernel of this interpreter, in a process of its own: `execute_notebook.py FOLDER IN...`.

The folder holds the kernel's specification, so that neither the user's kernels nor a network are needed, and gets the
executed notebooks. They share the kernel, whose start takes longer than most notebooks.
"""

import json
import os
import sys
from importlib import import_module
from pathlib import Path


def main() -> None:
    folder, *sources = map(Path, sys.argv[1:])
    kernel = folder / "kernels" / "this"
    kernel.mkdir(parents=True)
    argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    (kernel / "kernel.json").write_text(json.dumps({"argv": argv, "display_name": "this", "language": "python"}))
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR"):
        os.environ[name] = str(folder / name.lower())
    specifications = import_module("jupyter_client.kernelspec").KernelSpecManager(
        kernel_dirs=[str(kernel.parent)], ensure_native_kernel=False
    )
    manager = import_module("jupyter_client.manager").AsyncKernelManager(
        kernel_spec_manager=specifications, kernel_name="this"
    )
    read = import_module("nbformat").reads
    notebooks = [read(source.read_text(), as_version=4) for source in sources]
    joined = read(sources[0].read_text(), as_version=4)
    joined.cells = [cell for notebook in notebooks for cell in notebook.cells]
    where = {"metadata": {"path": str(folder)}}
    import_module("nbclient").NotebookClient(joined, km=manager, timeout=120, resources=where).execute()
    for source, notebook in zip(sources, notebooks, strict=True):
        (folder / source.name).write_text(json.dumps(notebook))


if __name__ == "__main__":
    main()
