"""Writes the table of docs/configuration.md from the settings: ``python docs/settings.py``."""

from __future__ import annotations

from pathlib import Path

from unbend_service.settings import settings_table

PAGE = Path(__file__).parent / "configuration.md"
START, END = "<!-- settings -->\n", "<!-- /settings -->"


def with_table(page: str) -> str:
    """The page's text with the table between its two markers renewed."""
    before, rest = page.split(START)
    _, after = rest.split(END)
    return f"{before}{START}{settings_table()}\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
