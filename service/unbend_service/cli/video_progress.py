"""The bar of ``unbend video``."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from rich import progress as bars

from unbend_service.application.video import Progress
from unbend_service.cli.reporting import errors

_REFRESH_S = 0.2


@contextmanager
def shown(progress: Progress, expected: int | None, quiet: bool) -> Iterator[None]:
    """A bar on standard error with frames a second and the time left; nothing where that is no terminal."""
    if quiet or not errors.is_terminal:
        yield
        return
    columns = (
        bars.TextColumn("{task.completed}" + ("" if expected is None else "/{task.total}") + " frames"),
        bars.BarColumn(),
        _Rate(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=errors, transient=True) as display:
        task = display.add_task("video", total=expected)
        loop = asyncio.get_running_loop()

        def look() -> None:
            display.update(task, completed=progress.frames)
            if display.live.is_started:
                loop.call_later(_REFRESH_S, look)

        look()
        yield
        display.update(task, completed=progress.frames)


class _Rate(bars.ProgressColumn):
    def render(self, task: bars.Task) -> str:
        return f"{task.finished_speed or task.speed or 0:.1f} fps"
