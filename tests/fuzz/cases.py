"""One input for the service, as bytes on the wire, so that it can be written down and sent again."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"


@dataclass(frozen=True, slots=True)
class HttpCase:
    """A request: its head without the lines that frame the body, and the body.

    Attributes:
        raw: sent as it is, without Content-Length and end of head, when there is no telling what it means.
    """

    head: bytes
    body: bytes = b""
    raw: bool = False

    @property
    def wire(self) -> bytes:
        if self.raw:
            return self.head + self.body
        return self.head + b"Host: fuzz\r\nContent-Length: %d\r\n\r\n" % len(self.body) + self.body


@dataclass(frozen=True, slots=True)
class GrpcCase:
    """A call: its method and its serialized messages; one message where the method takes one."""

    method: str
    messages: tuple[bytes, ...]
    streaming: bool = False


Case = HttpCase | GrpcCase


def write(case: Case, folder: Path) -> Path:
    """Writes a case under a name that its content gives."""

    def text(data: bytes) -> str:
        return base64.b64encode(data).decode()

    if isinstance(case, HttpCase):
        value: dict[str, object] = {"http": {"head": text(case.head), "body": text(case.body), "raw": case.raw}}
    else:
        messages = [text(message) for message in case.messages]
        value = {"grpc": {"method": case.method, "messages": messages, "streaming": case.streaming}}
    content = json.dumps(value, indent=1) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{next(iter(value))}-{hashlib.sha256(content.encode()).hexdigest()[:12]}.json"
    path.write_text(content)
    return path


def read(path: Path) -> Case:
    """Inverse of :func:`write`."""
    value = json.loads(path.read_text())
    if "http" in value:
        found = value["http"]
        return HttpCase(base64.b64decode(found["head"]), base64.b64decode(found["body"]), found["raw"])
    found = value["grpc"]
    messages = tuple(base64.b64decode(message) for message in found["messages"])
    return GrpcCase(found["method"], messages, found["streaming"])
