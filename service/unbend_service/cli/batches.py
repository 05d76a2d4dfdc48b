"""Many photographs in one command: which files, and where their results go."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from unbend_service.domain.errors import InvalidOption

#: Suffixes that are read, and the format that is written for each.
PHOTOGRAPHS = {
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".png": "png",
    ".webp": "webp",
    ".tif": "png",
    ".tiff": "png",
    ".bmp": "png",
}
_MAGIC = "*?["
_SUFFIXES = {"jpeg": ".jpg", "png": ".png", "webp": ".webp"}


@dataclass(frozen=True, slots=True)
class Job:
    """One photograph.

    Attributes:
        image_format: of the result.
    """

    source: Path
    target: Path
    image_format: str


def is_batch(source: str) -> bool:
    """Whether IN means several files: a directory, or a pattern that is not itself a file."""
    return Path(source).is_dir() or (any(c in source for c in _MAGIC) and not Path(source).exists())


def find_jobs(source: str, target: Path) -> list[Job]:
    """The photographs of a directory (with its folders) or of a pattern (``**`` for any depth), in order of name.

    Results lie in the directory ``target``, in the same folders under the same names; tiff and bmp become png.

    Raises:
        InvalidOption: no photograph, two that would have the same result, or a target that is a file.
    """
    if target.exists() and not target.is_dir():
        raise InvalidOption(f"{target} is a file.", allowed="a directory as OUT for many photographs")
    if Path(source).is_dir():
        root, found = Path(source), sorted(Path(source).rglob("*"))
    else:
        root = _root(source)
        found = sorted(Path(path) for path in glob.glob(source, recursive=True))
    inside = target.resolve()
    photographs = [
        path
        for path in found
        if path.suffix.lower() in PHOTOGRAPHS and path.is_file() and inside not in path.resolve().parents
    ]
    if not photographs:
        raise InvalidOption(f"{source} has no photograph.", allowed=", ".join(PHOTOGRAPHS))
    jobs = [_job(path, root, target) for path in photographs]
    _check_distinct(jobs)
    return jobs


def _root(source: str) -> Path:
    """The part of a pattern before its first wildcard, under which folders are kept."""
    parts = Path(source).parts
    length = next((i for i, part in enumerate(parts) if any(c in part for c in _MAGIC)), len(parts))
    return Path(*parts[:length]) if length else Path()


def _job(path: Path, root: Path, target: Path) -> Job:
    image_format = PHOTOGRAPHS[path.suffix.lower()]
    result = target / path.relative_to(root)
    if path.suffix.lower() in (".tif", ".tiff", ".bmp"):
        result = result.with_suffix(_SUFFIXES[image_format])
    return Job(path, result, image_format)


def _check_distinct(jobs: Sequence[Job]) -> None:
    seen: dict[Path, Path] = {}
    for job in jobs:
        other = seen.setdefault(job.target, job.source)
        if other != job.source:
            raise InvalidOption(f"{other} and {job.source} would both become {job.target}.", allowed="distinct names")
