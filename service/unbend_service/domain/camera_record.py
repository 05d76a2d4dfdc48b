"""What is remembered of a camera: the looks at its pictures, and what they say together.

Information adds up: with every picture the lens is known better, until more would not help, and the record locks. From
then on all pictures of the camera get the same grid.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from typing import Any

from unbend_service.domain.aggregation import Fused, Look, fuse
from unbend_service.domain.errors import InvalidGrid, InvalidInput, InvalidOption
from unbend_service.domain.guides import Guides

MOST_LOOKS = 16
ENOUGH_LOOKS = 5
GOOD_ENOUGH = 0.15 / 128
"""Expected error, half picture widths, at which ENOUGH_LOOKS lock the record before MOST_LOOKS do."""
_ASPECT_TOLERANCE = 0.01
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/+-]{0,127}")


def check_camera_name(name: str) -> str:
    """Raises InvalidOption unless it can name a camera."""
    if not _NAME.fullmatch(name):
        raise InvalidOption(
            f"camera={name!r:.80} cannot name a camera.",
            allowed="1 to 128 of A-Z a-z 0-9 . _ : @ / + -, a letter or digit first",
        )
    return name


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """The looks at one camera's pictures.

    Attributes:
        model, confidence_kind: of the estimates; looks of another model are not mixed with them.
        aspect: width over height of the pictures.
        looks: at most MOST_LOOKS.
        pictures: digests of the pictures, in the order of the looks: one picture counts once.
        fused: what they say together; its log says how many agree.
        version: grows with every change.
    """

    model: str
    confidence_kind: str
    aspect: float
    looks: tuple[Look, ...]
    pictures: tuple[str, ...]
    fused: Fused
    version: int = 1

    @classmethod
    def first(
        cls, model: str, confidence_kind: str, aspect: float, look: Look, picture: str, version: int = 1
    ) -> CameraRecord:
        """A record of one look."""
        return cls(model, confidence_kind, aspect, (look,), (picture,), fuse([look]), version)

    @property
    def is_locked(self) -> bool:
        """Whether further pictures change nothing."""
        enough = self.fused.agreeing >= ENOUGH_LOOKS and self.fused.expected_error <= GOOD_ENOUGH
        return enough or len(self.looks) >= MOST_LOOKS

    def with_look(self, look: Look, picture: str) -> CameraRecord:
        """The record with one more picture; itself if it is locked or has seen the picture."""
        if self.is_locked or picture in self.pictures:
            return self
        looks = (*self.looks, look)
        return replace(
            self, looks=looks, pictures=(*self.pictures, picture), fused=fuse(looks), version=self.version + 1
        )

    def check_aspect(self, aspect: float) -> None:
        """Raises InvalidOption for pictures of other proportions: they show another part of the lens."""
        if abs(aspect / self.aspect - 1) > _ASPECT_TOLERANCE:
            raise InvalidOption(
                f"A picture of aspect {aspect:.3f} for a camera whose pictures have {self.aspect:.3f}.",
                allowed="one aspect for each camera name: give upright and cropped pictures another one",
            )

    def to_bytes(self) -> bytes:
        """JSON."""
        looks = [
            {"guides": look.guides.to_dict(), "confidence": look.confidence, "expected_error": look.expected_error}
            for look in self.looks
        ]
        fused = {
            "guides": self.fused.guides.to_dict(),
            "confidence": self.fused.confidence,
            "expected_error": self.fused.expected_error,
            "agreeing": self.fused.agreeing,
        }
        fields = {
            "model": self.model,
            "confidence_kind": self.confidence_kind,
            "aspect": self.aspect,
            "looks": looks,
            "pictures": self.pictures,
            "fused": fused,
            "version": self.version,
        }
        return json.dumps(fields).encode()

    @classmethod
    def from_bytes(cls, value: bytes) -> CameraRecord:
        """Inverse of :meth:`to_bytes`; raises InvalidGrid for anything else."""
        try:
            fields: dict[str, Any] = json.loads(value)
            looks = tuple(
                Look(Guides.from_dict(one["guides"]), float(one["confidence"]), _number(one["expected_error"]))
                for one in fields["looks"]
            )
            fused = fields["fused"]
            return cls(
                str(fields["model"]),
                str(fields["confidence_kind"]),
                float(fields["aspect"]),
                looks,
                tuple(map(str, fields["pictures"])),
                Fused(
                    Guides.from_dict(fused["guides"]),
                    float(fused["confidence"]),
                    float(fused["expected_error"]),
                    int(fused["agreeing"]),
                ),
                int(fields["version"]),
            )
        except (InvalidInput, ValueError, KeyError, TypeError) as error:
            raise InvalidGrid("The stored record of the camera is damaged.") from error


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
