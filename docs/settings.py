"""Writes the tables of README.md and docs/configuration.md from the settings: ``python docs/settings.py``."""

from __future__ import annotations

from pathlib import Path

from unbend_service.settings import settings_table

PAGES = (Path(__file__).parent.parent / "README.md", Path(__file__).parent / "configuration.md")
START, END = "<!-- settings -->\n", "<!-- /settings -->"


def with_table(page: str) -> str:
    """The page's text with the table between its two markers renewed."""
    before, rest = page.split(START)
    _, after = rest.split(END)
    return f"{before}{START}{settings_table()}\n{END}{after}"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_table(page.read_text()))
