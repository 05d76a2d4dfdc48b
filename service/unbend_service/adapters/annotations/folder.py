"""AnnotationFolder: pictures of a folder, each annotation a JSON file beside its picture."""

from __future__ import annotations

import os
from pathlib import Path

import orjson

from unbend_service.domain.annotation import Annotation
from unbend_service.domain.errors import InvalidGuides

SUFFIX = ".unbend.json"
#: What browsers show.
PICTURES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp"})


class AnnotationFolder:
    """The pictures that lie in ``folder`` itself when it is opened; names from outside are only ever looked up."""

    def __init__(self, folder: Path) -> None:
        self._files = {
            file.name: file for file in sorted(folder.iterdir()) if file.suffix.lower() in PICTURES and file.is_file()
        }
        self._title = folder.resolve().name

    @property
    def title(self) -> str:
        return self._title

    def names(self) -> list[str]:
        return list(self._files)

    def picture(self, name: str) -> bytes | None:
        file = self._files.get(name)
        return None if file is None else file.read_bytes()

    def read(self, name: str) -> Annotation | None:
        file = self._files.get(name)
        if file is None:
            return None
        try:
            return Annotation.from_dict(orjson.loads(_beside(file).read_bytes()))
        except FileNotFoundError:
            return None
        except orjson.JSONDecodeError as error:
            raise InvalidGuides(f"{_beside(file).name} is not JSON: {error}.") from error

    def write(self, annotation: Annotation) -> None:
        """Written whole and then put in place, so that an interruption leaves the former one. Raises OSError."""
        target = _beside(self._files[annotation.image])
        unfinished = target.with_name(f".{target.name}.{os.getpid()}")
        unfinished.write_bytes(orjson.dumps(annotation.to_dict(), option=orjson.OPT_INDENT_2))
        unfinished.replace(target)


def _beside(file: Path) -> Path:
    return file.with_name(file.name + SUFFIX)
