"""The other servers of an installation, real ones, in processes of their own: Redis and HAProxy."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

_START_S = 10.0


class MissingProgram(RuntimeError):
    """A program of the system is not installed."""


def free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody listens on just now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


class Companion:
    """A server process that may be paused, killed and started again on the same port.

    Args:
        port: that answers once the server is up.
        log: file that its output is appended to.
    """

    def __init__(self, command: list[str], port: int, log: Path, environment: dict[str, str] | None = None) -> None:
        places = (None, str(Path(sys.executable).parent), "/usr/sbin:/usr/local/sbin")
        found = next(filter(None, (shutil.which(command[0], path=place) for place in places)), None)
        if found is None:
            raise MissingProgram(f"{command[0]} is not installed (Debian: apt-get install {command[0]})")
        self._command = [found, *command[1:]]
        self._environment = environment
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self.port = port
        self.start()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Starts it and waits until its port answers."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(self._command, stdout=log, stderr=log, env=self._environment)
        end = time.monotonic() + _START_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
                return
            except OSError:
                if self._process.poll() is not None or time.monotonic() > end:
                    self.stop()
                    raise RuntimeError(f"{self._command[0]} did not start: {self._log.read_text()[-2000:]}") from None
            time.sleep(0.02)

    def pause(self) -> None:
        """It keeps its connections and answers nothing."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Ends it as a power failure would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def stop(self) -> None:
        """Ends it as it wants to be ended."""
        if self._process is None or self._process.poll() is not None:
            return
        self._process.send_signal(signal.SIGCONT)
        self._process.terminate()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self.kill()


def redis_server(folder: Path, *options: str, port: int | None = None) -> Companion:
    """A redis-server that keeps nothing on disk, on 127.0.0.1; ``options`` as on its command line."""
    port = port or free_port()
    listening = [] if "--tls-port" in options else ["--port", str(port)]
    command = ["redis-server", "--bind", "127.0.0.1", *listening, "--save", "", "--appendonly", "no", *options]
    return Companion([*command, "--dir", str(folder)], port, folder / f"redis-{port}.log")
