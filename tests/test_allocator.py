from __future__ import annotations

import subprocess
import sys

import pytest

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
