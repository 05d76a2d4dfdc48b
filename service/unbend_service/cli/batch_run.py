"""Many photographs in one command: corrected in parallel, with a bar and a summary."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import typer
from rich import progress as bars

from unbend_service.application.correction import CorrectedImage, CorrectOptions
from unbend_service.application.service import Service
from unbend_service.cli.batches import Job
from unbend_service.cli.private import private_service
from unbend_service.cli.reporting import EXIT_FAILED, console, errors, print_json
from unbend_service.domain.errors import UnbendError
from unbend_service.domain.records import Outcome
from unbend_service.settings import Settings

EXIT_INTERRUPTED = 130


@dataclass(slots=True)
class Batch:
    """What became of many photographs.

    Attributes:
        failed: the sentence for each file that failed, by its path.
    """

    total: int
    corrected: int = 0
    left_alone: int = 0
    skipped: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    interrupted: bool = False


def correct_jobs(settings: Settings, jobs: Sequence[Job], options: CorrectOptions, *, overwrite: bool) -> Batch:
    """Corrects ``jobs``; a file that fails does not keep the others. The first Ctrl-C ends after those under way.

    Raises:
        UnbendError: no renderer or no model.
    """
    batch = Batch(len(jobs))
    open_jobs = [job for job in jobs if overwrite or not job.target.exists()]
    batch.skipped = len(jobs) - len(open_jobs)
    if open_jobs:
        asyncio.run(_run(settings, open_jobs, options, batch))
    return batch


def report_batch(batch: Batch, as_json: bool) -> None:
    """Prints the summary; ends the command with a code that says whether all went well."""
    if as_json:
        counts = {"total": batch.total, "corrected": batch.corrected, "left_alone": batch.left_alone}
        print_json({**counts, "skipped": batch.skipped, "failed": batch.failed, "interrupted": batch.interrupted})
    else:
        for path, sentence in batch.failed.items():
            errors.print(f"{path}: {sentence}", style="red", markup=False, highlight=False, soft_wrap=True)
        console.print(
            f"{batch.total} photographs: {batch.corrected} corrected, {batch.left_alone} left alone, "
            f"{batch.skipped} were there already, {len(batch.failed)} failed",
            highlight=False,
        )
    if batch.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    if batch.failed:
        raise typer.Exit(EXIT_FAILED)


async def _run(settings: Settings, jobs: Sequence[Job], options: CorrectOptions, batch: Batch) -> None:
    loop = asyncio.get_running_loop()

    def stop(number: signal.Signals) -> None:
        batch.interrupted = True
        loop.remove_signal_handler(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop, number)
    columns = (
        bars.TextColumn("{task.completed}/{task.total}"),
        bars.BarColumn(),
        bars.TextColumn("{task.fields[name]}"),
        bars.TimeRemainingColumn(),
    )
    waiting = iter(jobs)
    hidden = not errors.is_terminal
    async with private_service(settings) as service:
        with bars.Progress(*columns, console=errors, transient=True, disable=hidden) as display:
            bar = display.add_task("photographs", total=len(jobs), name="")

            async def work() -> None:
                for job in waiting:
                    if batch.interrupted:
                        return
                    await _correct(service, job, options, batch)
                    display.update(bar, advance=1, name=job.source.name)

            async with asyncio.TaskGroup() as group:
                for _ in range(2 * max(1, service.correction.render_workers)):
                    group.create_task(work())
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.remove_signal_handler(number)


async def _correct(service: Service, job: Job, options: CorrectOptions, batch: Batch) -> None:
    try:
        body = await asyncio.to_thread(job.source.read_bytes)
        result = await service.correction.of_image(body, replace(options, image_format=job.image_format))
        await asyncio.to_thread(_write, job, result)
    except UnbendError as error:
        batch.failed[str(job.source)] = str(error)
    except OSError as error:
        batch.failed[str(job.source)] = error.strerror or str(error)
    else:
        if result.record.outcome is Outcome.LEFT_ALONE:
            batch.left_alone += 1
        else:
            batch.corrected += 1


def _write(job: Job, result: CorrectedImage) -> None:
    """Whole or not at all: a run that is cut off leaves nothing that a later one would take for done."""
    job.target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = job.target.with_name(f".{job.target.name}.{os.getpid()}.part")
    try:
        unfinished.write_bytes(result.body)
        unfinished.replace(job.target)
    finally:
        unfinished.unlink(missing_ok=True)
