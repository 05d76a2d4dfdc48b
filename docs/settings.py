"""Writes the configuration table of the README from the settings: ``python docs/settings.py``."""

from __future__ import annotations

from pathlib import Path

from unbend_service.settings import settings_table

README = Path(__file__).parent.parent / "README.md"
START, END = "<!-- settings -->\n", "<!-- /settings -->"


def with_table(readme: str) -> str:
    """The README's text with the table between its two markers renewed."""
    before, rest = readme.split(START)
    _, after = rest.split(END)
    return f"{before}{START}{settings_table()}\n{END}{after}"


if __name__ == "__main__":
    README.write_text(with_table(README.read_text()))
