"""Importing the package loads no Bullet, and Bullet never writes to the streams of its process."""

from __future__ import annotations

import subprocess
import sys


def run(code: str) -> subprocess.CompletedProcess[bytes]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120, check=False)
    assert b"Traceback" not in done.stderr, done.stderr.decode()
    return done


def test_importing_the_package_does_not_import_bullet_or_numpy() -> None:
    done = run(
        "import sys, pycrorm_async.world as world\n"
        "bullets = {'pybullet', 'pycram_bullet', 'optik'}\n"
        "world.Pose, world.ObjectType\n"
        "print(bullets & set(sys.modules), 'numpy' in sys.modules)\n"
        "world.BulletWorld, world.Object, world.OccupancyCostmap\n"
        "print(bullets & set(sys.modules))\n"
    )
    assert (done.stdout, done.stderr) == (b"set() False\nset()\n", b"")


def test_every_public_name_exists() -> None:
    done = run(
        "import pycrorm_async.world as world\n"
        "for name in world.__all__:\n"
        "    getattr(world, name)\n"
        "assert dir(world) == sorted(world.__all__)\n"
        "try:\n    world.nothing\nexcept AttributeError as refused:\n    print(refused)\n"
    )
    assert done.stdout == b"module 'pycrorm_async.world' has no attribute 'nothing'\n"
    assert done.returncode == 0


def test_nothing_of_bullet_reaches_stdout_or_stderr() -> None:
    """Neither its greeting nor its warnings about a link without inertia or an unreadable mesh are printed."""
    done = run(
        "import tempfile\n"
        "from pycrorm_async.world import *\n"
        "from pycrorm_async.world.pose import DescriptionNotLoadable\n"
        "print('before')\n"
        'link = \'<robot name="a"><link name="l"><collision><geometry>{}</geometry></collision></link></robot>\'\n'
        "with BulletWorld(), tempfile.NamedTemporaryFile(suffix='.stl') as empty:\n"
        "    Object('pr2', ObjectType.ROBOT)\n"
        "    Object('kitchen', ObjectType.ENVIRONMENT)\n"
        "    Object('bare', ObjectType.GENERIC_OBJECT, link.format('<box size=\"1 1 1\"/>'))\n"
        "    Object('empty', ObjectType.GENERIC_OBJECT, link.format(f'<mesh filename=\"{empty.name}\"/>'))\n"
        "    try:\n        Object('bad', ObjectType.GENERIC_OBJECT, link.format('<box/>'))\n"
        "    except DescriptionNotLoadable:\n        print('refused')\n"
        "print('after')\n"
    )
    assert (done.stdout, done.stderr, done.returncode) == (b"before\nrefused\nafter\n", b"", 0)


def test_output_of_other_threads_meanwhile_is_not_swallowed() -> None:
    done = run(
        "import threading, os\n"
        "from pycrorm_async.world import *\n"
        "stop = threading.Event()\n"
        "lines = 0\n"
        "def speak():\n"
        "    global lines\n"
        "    while not stop.is_set():\n"
        "        os.write(1, b'spoken\\n'); lines += 1\n"
        "thread = threading.Thread(target=speak); thread.start()\n"
        "try:\n"
        "    with BulletWorld():\n"
        "        for k in range(20): Object(f'milk {k}', ObjectType.MILK)\n"
        "finally:\n"
        "    stop.set(); thread.join()\n"
        "os.write(2, str(lines).encode())\n"
    )
    assert done.stdout == b"spoken\n" * int(done.stderr)
    assert int(done.stderr) > 0


def test_the_streams_of_c_and_cpp_are_the_real_ones_afterwards() -> None:
    """The C++ runtime is loaded with Bullet: it must not keep the memory that replaced stdout meanwhile."""
    done = run(
        "import ctypes\n"
        "from pycrorm_async.world import *\n"
        "with BulletWorld():\n"
        "    Object('milk', ObjectType.MILK)\n"
        "ctypes.CDLL(None).printf(b'C\\n')\n"
        "ctypes.CDLL(None).fflush(None)\n"
        "cpp = ctypes.CDLL('libstdc++.so.6')\n"
        "cout = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.in_dll(cpp, '_ZSt4cout')))\n"
        "cpp._ZNSo3putEc(cout, ctypes.c_char(b'+'))\n"
        "cpp._ZNSo5flushEv(cout)\n"
    )
    assert (done.stdout, done.stderr, done.returncode) == (b"C\n+", b"", 0)
