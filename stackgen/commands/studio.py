"""stackgen studio: draw a silhouette in the browser, and watch it become a structure."""

from __future__ import annotations

import os
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.parsing import Command
from stackgen.errors import StackgenError, require


def main(
    port: int = 8011, host: str = "127.0.0.1", workers: int | None = None, gallery: Path = Path("."), open: bool = False
) -> None:
    """Serve the studio on this machine: draw a silhouette, see structures that stand, and have one built.

    Args:
        port: Port of the page; 0 for any that is free.
        host: Address to listen at; only this machine reaches the default.
        workers: Number of processes that work; one for each core by default, at most 4.
        gallery: Folder whose results the page shows: stacks files, pictures and tables below it.
        open: Whether to open the page in a browser.
    """
    if not 0 <= port <= 65535:
        raise StackgenError(f"--port must lie in 0..65535, got {port}")
    if workers is not None and not 1 <= workers <= 64:
        raise StackgenError(f"--workers must lie in 1..64, got {workers}")
    if not gallery.is_dir():
        raise StackgenError(f"--gallery {gallery} is no folder; give the one that holds your results")
    require("fastapi", "studio")
    require("uvicorn", "studio")
    from stackgen.studio.serving import serve

    def ready(address: str) -> None:
        print(f"The studio is at {address} (Ctrl-C ends it)", flush=True)
        if open:
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

    serve(host, port, workers or min(4, os.cpu_count() or 1), gallery, ready)


COMMAND = Command(
    "studio",
    main,
    """
    stackgen studio --open
    stackgen studio --port 8080 --workers 1
    """,
    flags={"open": "Open the page in a browser."},
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # as for `sample`
    return COMMAND.run(argv)
