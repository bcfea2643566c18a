"""What the benchmarks share: facts about the machine, child processes that are measured, results as table and file."""

from __future__ import annotations

import argparse
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from stackgen.errors import StackgenError
from stackgen.io.files import write_json

ROOT = Path(__file__).parents[1]
FORMAT = "stackgen.benchmark/1"
PACKAGES = ("stackgen", "numpy", "torch", "lightning", "pybullet", "mujoco")


@dataclass(frozen=True)
class Child:
    """A process that ended.

    Args:
        output: What it printed.
        seconds: Time from its start to its end [s].
        peak_rss_mb: Largest resident memory [MB].
    """

    output: str
    seconds: float
    peak_rss_mb: float


def run_child(arguments: Sequence[str], threads: int | None = None) -> Child:
    """Run a command to its end, in the repository root.

    On Linux a process inherits the peak of the process that started it: measure children before importing much.

    Args:
        arguments: Words of the command.
        threads: Threads of OpenMP; by default what the environment says.

    Raises:
        StackgenError: If it fails; the message ends with its last line.
    """
    environment = {**os.environ, **({} if threads is None else {"OMP_NUM_THREADS": str(threads)})}
    start = time.perf_counter()
    process = subprocess.Popen(
        arguments, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        last = (output.strip().splitlines() or ["(no output)"])[-1]
        raise StackgenError(f"`{' '.join(arguments[1:])}` ended with {process.returncode}: {last}")
    return Child(output, seconds, _megabytes(usage.ru_maxrss))


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far [MB]."""
    return _megabytes(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def _megabytes(maxrss: int) -> float:
    return maxrss / (1e6 if sys.platform == "darwin" else 1e6 / 1024)  # bytes there, KiB elsewhere


def summary(values: Sequence[float]) -> dict[str, float]:
    """Median, extremes and number of repeated measurements.

    >>> summary([3.0, 1.0, 2.0])
    {'median': 2.0, 'min': 1.0, 'max': 3.0, 'runs': 3}
    """
    return {"median": statistics.median(values), "min": min(values), "max": max(values), "runs": len(values)}


def machine() -> dict[str, Any]:
    """What the metrics depend on: processor, load, versions, commit."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
        "day": datetime.now(UTC).date().isoformat(),
    }


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor()
    )


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit, with `+` where the working tree differs from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def argument_parser(module: str, description: str | None) -> argparse.ArgumentParser:
    """A parser with what all benchmarks take."""
    name = module if module != "__main__" else sys.modules["__main__"].__spec__.name  # type: ignore[union-attr]
    parser = argparse.ArgumentParser(
        prog=f"python -m {name}",
        description=(description or "").partition("\n\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="file for the metrics too")
    return parser


def report(name: str, metrics: Mapping[str, Any], tables: Sequence[Table], out: Path | None) -> None:
    """Print tables and machine; write everything as JSON if there is where to."""
    facts = machine()
    console = Console()
    for table in tables:
        console.print(table)
    versions = ", ".join(f"{package} {number}" for package, number in facts["packages"].items() if number)
    console.print(
        f"{facts['cpu']}, {facts['cores']} cores, load {facts['load_average'][0]}, Python {facts['python']}, "
        f"{versions}, commit {facts['commit']}",
        style="dim",
        highlight=False,
    )
    if out is not None:
        save(name, metrics, out)
        console.print(f"wrote {out}", highlight=False)


def save(name: str, metrics: Mapping[str, Any], out: Path) -> None:
    """Write metrics as JSON, with the command and the machine that made them."""
    content = {
        "format": FORMAT,
        "benchmark": name,
        "command": " ".join([f"python -m benchmarks.{name}", *sys.argv[1:]]),
        "machine": machine(),
        "figures": metrics,  # the key of the files in docs/results
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, content)


def plain_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Make a table whose first column is text and whose others are numbers."""
    table = Table(title=escape(title))
    for number, heading in enumerate(headings):
        table.add_column(escape(heading), justify="right" if number else "left")
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def start(main: Callable[[], None]) -> None:
    """Run a benchmark; errors that a user can mend are one line and exit code 2."""
    try:
        main()
    except StackgenError as error:
        sys.exit(_complaint(str(error), 2))
    except KeyboardInterrupt:
        sys.exit(_complaint("interrupted", 130))


def _complaint(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return code


def percent(estimate: Mapping[str, float] | None) -> str:
    """Write a share and its interval in percent, a dash where there is none.

    >>> percent({"value": 0.953, "low": 0.94, "high": 0.97})
    '95.3 (94-97)'
    """
    if estimate is None:
        return "-"
    return f"{100 * estimate['value']:.1f} ({100 * estimate['low']:.0f}-{100 * estimate['high']:.0f})"
