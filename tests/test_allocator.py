from __future__ import annotations

import subprocess
import sys

import pytest

from unbend_service.allocator import heap

#: Resident MiB of threads' own arenas: each of 32 threads frees what it had, but for a crumb at the end of it.
PROGRAM = """
import ctypes, re, subprocess, sys, threading
from unbend_service.allocator import share_arenas
if sys.argv[1] == "shared":
    share_arenas()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
ready = threading.Barrier(33)
def work():
    libc.malloc(1000)
    ready.wait()
    ready.wait()
threads = [threading.Thread(target=work) for _ in range(32)]
for thread in threads:
    thread.start()
ready.wait()
libc.malloc_info.argtypes = [ctypes.c_int, ctypes.c_void_p]
libc.fopen.restype = ctypes.c_void_p
libc.fclose.argtypes = [ctypes.c_void_p]
file = libc.fopen(sys.argv[2].encode(), b"w")
libc.malloc_info(0, file)
libc.fclose(file)
ready.wait()
print(len(re.findall("<heap nr", open(sys.argv[2]).read())))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="speaks of glibc")
def test_threads_share_two_arenas(tmp_path: object) -> None:
    """However many threads allocate, the memory they free is kept in two places."""

    def arenas(how: str) -> int:
        command = [sys.executable, "-c", PROGRAM, how, f"{tmp_path}/{how}"]
        return int(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)

    assert arenas("shared") <= 2 < arenas("own")


#: MB that are resident before and after, of 100 MB all of which but the last crumb are free.
GIVING_BACK = """
from unbend_service.allocator import give_back
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 // 10**6
held = [bytearray(b"x" * 50_000) for _ in range(2000)]
del held[:-1]
before = resident()
give_back()
print(before, resident())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="speaks of glibc")
def test_what_is_free_goes_back_to_the_system() -> None:
    """A block that stays does not keep what was freed below it."""
    command = [sys.executable, "-c", GIVING_BACK]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    before, after = map(int, done.stdout.split())
    assert before - after > 80


@pytest.mark.skipif(sys.platform != "linux", reason="speaks of glibc")
def test_what_is_handed_out_and_what_is_kept_free_are_told_apart() -> None:
    """Whoever looks for a leak sees whether memory is in use."""
    before = heap()
    held = bytearray(64 << 20)
    during = heap()
    del held
    after = heap()
    assert before is not None
    assert during is not None
    assert after is not None
    assert during.used_bytes - before.used_bytes > 60 << 20
    assert after.used_bytes - before.used_bytes < 8 << 20
