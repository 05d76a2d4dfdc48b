"""One line of the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        status: ``ok``, ``note`` (works, could be better) or ``bad`` (the service will not work as it is set up).
        remedy: what to do about it; empty when ok.
    """

    name: str
    status: str
    detail: str
    remedy: str = ""
