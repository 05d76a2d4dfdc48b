"""What the annotation page needs from the outside."""

from __future__ import annotations

from typing import Protocol

from unbend_service.domain.annotation import Annotation


class AnnotationStore(Protocol):
    """Pictures that are annotated, and what was said of them. Names come from :meth:`names` and nowhere else."""

    @property
    def title(self) -> str:
        """What people call the collection."""
        ...

    def names(self) -> list[str]:
        """The pictures, in the order in which they are worked through."""
        ...

    def picture(self, name: str) -> bytes | None:
        """The file of a picture; None for a name that is not among :meth:`names`."""
        ...

    def read(self, name: str) -> Annotation | None:
        """What was said so far; None if nothing was. Raises InvalidGuides for a file that is no annotation."""
        ...

    def write(self, annotation: Annotation) -> None:
        """Keeps it, in place of what was said before."""
        ...
