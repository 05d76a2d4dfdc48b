"""What a long run has to say in the end."""

from __future__ import annotations

from dataclasses import dataclass, field

#: Seconds that a run has to last for its times to be judged.
TIMED_FROM_S = 60.0


@dataclass
class Verdict:
    """Figures, and those of them that broke a promise.

    Attributes:
        timed: whether times are held to their bars; a run of less than a minute shows that it runs and loses nothing.
    """

    name: str
    timed: bool = True
    figures: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)

    def say(self, figure: str, kept: bool = True) -> None:
        """Adds a figure; ``kept``: whether it is as promised."""
        self.figures.append(figure)
        print(f"  {'ok ' if kept else 'BAD'} {figure}", flush=True)
        if not kept:
            self.broken.append(figure)

    def say_time(self, figure: str, kept: bool) -> None:
        """Adds a time."""
        self.say(figure if self.timed else f"{figure} [not judged]", kept or not self.timed)

    @property
    def passed(self) -> bool:
        return not self.broken

    def __str__(self) -> str:
        text = f"{self.name.upper()} {'PASS' if self.passed else 'FAIL'}: {'; '.join(self.figures)}"
        return text if self.passed else f"{text} | BROKEN: {'; '.join(self.broken)}"
