"""What is printed for a person: no text out of a file or from a machine moves the cursor of the terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from stackgen.errors import printable


class Screen(Console):
    """A console that shows control characters instead of obeying them; line breaks are kept."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Turn text into what is shown, lines and cells of tables alike."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)
