"""Exits 0 if the service of this container is ready. Run every few seconds, so it imports little."""

from __future__ import annotations

import os
import ssl
import sys
from http.client import HTTPConnection, HTTPSConnection

port = int(os.environ.get("UNBEND_OPS_PORT") or os.environ.get("UNBEND_HTTP_PORT", "8080"))
if "UNBEND_TLS_CERT" in os.environ:
    # the certificate is not made out to the loopback, and nothing is told to whoever answers there
    unverified = ssl._create_unverified_context()
    connection: HTTPConnection = HTTPSConnection("127.0.0.1", port, timeout=4, context=unverified)
else:
    connection = HTTPConnection("127.0.0.1", port, timeout=4)
try:
    connection.request("GET", "/readyz")
    answer = connection.getresponse()
    body = answer.read().decode(errors="replace")
except OSError as error:
    sys.exit(f"no answer: {error}")
if answer.status != 200:
    sys.exit(body)
