"""What a long run has to say in the end."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Verdict:
    """Figures, and those of them that broke a promise."""

    name: str
    figures: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)

    def say(self, figure: str, kept: bool = True) -> None:
        """Adds a figure; ``kept``: whether it is as promised."""
        self.figures.append(figure)
        print(f"  {'ok ' if kept else 'BAD'} {figure}", flush=True)
        if not kept:
            self.broken.append(figure)

    @property
    def passed(self) -> bool:
        return not self.broken

    def __str__(self) -> str:
        text = f"{self.name.upper()} {'PASS' if self.passed else 'FAIL'}: {'; '.join(self.figures)}"
        return text if self.passed else f"{text} | BROKEN: {'; '.join(self.broken)}"
