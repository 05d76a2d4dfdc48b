"""Generates client/unbend/v1 from proto/unbend/v1; ``--check`` only says whether the committed code is up to date."""

from __future__ import annotations

import argparse
import filecmp
import os
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

from grpc_tools import protoc

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "proto"
TARGET = ROOT / "client"


def generate(target: Path) -> None:
    """Writes *_pb2.py, *_pb2.pyi, *_pb2_grpc.py and *_pb2_grpc.pyi below ``target``/unbend/v1."""
    protos = sorted(str(path.relative_to(SOURCES)) for path in (SOURCES / "unbend" / "v1").glob("*.proto"))
    well_known = str(files("grpc_tools") / "_proto")
    arguments = [
        "protoc",
        f"-I{SOURCES}",
        f"-I{well_known}",
        f"--python_out={target}",
        f"--grpc_python_out={target}",
        f"--mypy_out={target}",
        f"--mypy_grpc_out={target}",
        *protos,
    ]
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # where the plug-ins are
    if protoc.main(arguments) != 0:
        raise SystemExit("protoc failed")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    if not parser.parse_args().check:
        generate(TARGET)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        generate(Path(folder))
        fresh = Path(folder) / "unbend" / "v1"
        committed = TARGET / "unbend" / "v1"
        names = sorted(path.name for path in fresh.iterdir())
        stale = [n for n in names if not (committed / n).exists() or not filecmp.cmp(fresh / n, committed / n, False)]
        stale += [p.name for p in committed.glob("*_pb2*") if p.name not in names]
    if stale:
        print("generated code is not up to date (run `make proto`):", ", ".join(stale))
        return 1
    print(f"{len(names)} generated files are up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
