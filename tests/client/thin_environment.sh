#!/usr/bin/env bash
# The client in an environment of its own: the wheel, and what it says it needs.
# Usage: thin_environment.sh [PYTHON]
set -euo pipefail

python=${1:-python3}
root=$(cd "$(dirname "$0")/../.." && pwd)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"$python" -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check -c "$root/constraints.txt" "$root"
"$folder/venv/bin/python" -m pip list --disable-pip-version-check --format=freeze
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import importlib.metadata
import subprocess
import sys

import unbend

for name in unbend.__all__:
    getattr(unbend, name)
installed = {distribution.name.lower() for distribution in importlib.metadata.distributions()}
extra = installed - {"unbend", "numpy", "grpcio", "protobuf", "typing-extensions", "typing_extensions", "pip", "setuptools"}
assert not extra, f"more than the client needs: {extra}"
with unbend.Client("127.0.0.1:9", retries=0) as client:
    try:
        client.correct(b"\xff\xd8\xff")
    except unbend.Unreachable:
        pass
    else:
        raise AssertionError("nobody is there, and somebody answered")
command = subprocess.run([sys.executable, "-m", "unbend", "doctor"], capture_output=True, text=True)
assert command.returncode != 0 and "unbend[service]" in command.stderr, command
print("the client is thin")
PYTHON
