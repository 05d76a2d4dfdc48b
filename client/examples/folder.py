"""Straighten every photograph of a folder, several at a time.

    python folder.py holiday/ straight/

What is there already is skipped, so that a run that was interrupted can be started again. One bad file does not stop
the others; the summary counts it.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from collections import Counter
from pathlib import Path

import unbend

ENDINGS = {".jpg", ".jpeg", ".png", ".webp"}


async def straighten(client: unbend.AsyncClient, source: Path, target: Path) -> str:
    """Writes one picture and says what became of it."""
    try:
        correction = await client.correct(await asyncio.to_thread(source.read_bytes))
    except unbend.InvalidInput as error:
        print(f"{source}: {error}", file=sys.stderr)
        return "failed"
    await asyncio.to_thread(write, target, correction.image)
    return correction.outcome.value


def write(target: Path, body: bytes) -> None:
    """Under its name only once it is whole."""
    unfinished = target.with_name(target.name + ".part")
    unfinished.write_bytes(body)
    unfinished.rename(target)


async def straighten_all(pairs: list[tuple[Path, Path]], address: str, at_once: int) -> Counter[str]:
    """How many pictures ended how."""
    turns = asyncio.Semaphore(at_once)
    async with unbend.AsyncClient(address, timeout_s=120, retries=8) as client:

        async def take_turn(source: Path, target: Path) -> str:
            async with turns:
                return await straighten(client, source, target)

        return Counter(await asyncio.gather(*(take_turn(*pair) for pair in pairs)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of .jpg, .png and .webp files")
    parser.add_argument("out", type=Path, help="folder for the results; made if it is not there")
    parser.add_argument("--at-once", type=int, default=4, help="pictures under way at a time [%(default)s]")
    parser.add_argument("--target", default="127.0.0.1:50051", help="host:port of Unbend [%(default)s]")
    options = parser.parse_args()

    options.out.mkdir(parents=True, exist_ok=True)
    sources = sorted(path for path in options.folder.iterdir() if path.suffix.lower() in ENDINGS)
    todo = [(source, options.out / source.name) for source in sources if not (options.out / source.name).exists()]
    counts = asyncio.run(straighten_all(todo, options.target, options.at_once))
    counts["skipped"] = len(sources) - len(todo)
    print(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in sorted(counts.items())))
    sys.exit(1 if counts["failed"] else 0)


if __name__ == "__main__":
    main()
