"""Log lines: structured, one a line, on standard error."""

from __future__ import annotations

import logging
import sys
from typing import Any

import structlog

from unbend_service.domain.access import PREFIX, TOKEN
from unbend_service.settings import Settings


def strike_tokens(logger: object, name: str, line: Any) -> str:
    """The rendered line without tokens: callers put them into paths, ids and texts of errors."""
    return TOKEN.sub(f"{PREFIX}***", str(line))


def configure_logs(settings: Settings) -> None:
    """Sets structlog and the standard library's logging up for a process. Called by commands, never on import."""
    level = logging.getLevelNamesMapping()[settings.log_level.upper()]
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    if settings.log_format == "json":
        renderer: list[structlog.typing.Processor] = [
            # without local variables: they hold whole pictures
            structlog.processors.ExceptionRenderer(structlog.tracebacks.ExceptionDictTransformer(show_locals=False)),
            structlog.processors.JSONRenderer(),
        ]
    else:
        # the default formatter prints local variables, whole pictures among them, and takes seconds for it
        plain = structlog.dev.plain_traceback
        renderer = [structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=plain)]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderer, strike_tokens],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level)
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.stdlib.LoggerFactory(),
    )
