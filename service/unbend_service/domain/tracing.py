"""W3C Trace Context, as far as it is needed to say which trace a request belongs to."""

from __future__ import annotations

import re

_TRACEPARENT = re.compile(r"(?!ff)[0-9a-f]{2}-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}(-.*)?")


def trace_id_of(traceparent: str | None) -> str:
    """The trace of a ``traceparent``, 32 hexadecimal digits; empty if it says none, or is broken."""
    found = _TRACEPARENT.fullmatch(traceparent or "")
    return found[1] if found else ""
