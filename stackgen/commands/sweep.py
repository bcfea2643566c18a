"""stackgen sweep: many trials of a program, the best configuration at the end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from stackgen.commands import output
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import progress_bar
from stackgen.errors import StackgenError, require
from stackgen.training.runs import RUNS
from stackgen.training.sweeps.file import Sweep


def main(sweep: Sweep, out: Path | None = None, parallel: int = 1, seed: int = 0, export_wandb: bool = False) -> None:
    """Try many settings of a program, as a W&B sweep file says; Optuna runs it here, without an account.

    A sweep that was stopped or killed continues with the same command.

    Args:
        sweep: The sweep file.
        out: Folder of the sweep; runs/sweeps/NAME by default.
        parallel: Number of trials at once; they share the processor's cores.
        seed: Seed of the proposals.
        export_wandb: Whether to print the file for `wandb sweep` instead.
    """
    if export_wandb:
        sys.stdout.write(sweep.to_yaml())
        return
    if parallel < 1 or seed < 0:
        raise StackgenError(f"--parallel must be at least 1 and --seed at least 0, got {parallel} and {seed}")
    require("optuna", "sweeps")
    from stackgen.training.sweeps.coordinator import JOURNAL, run_sweep, trials_wanted
    from stackgen.training.sweeps.findings import leaderboard_table, ranking, write_findings

    folder = out or RUNS / "sweeps" / sweep.name
    with progress_bar(sweep.name, trials_wanted(sweep)) as (advance, tell):
        try:
            study = run_sweep(sweep, folder, parallel=parallel, seed=seed, tell=tell, advance=advance)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the same command continues the sweep") from None
    written = write_findings(study, sweep, folder)
    output.tell(leaderboard_table(ranking(study), sweep), folder=folder)
    output.wrote(*written)
    output.tell(f"to look at every trial: optuna-dashboard {folder / JOURNAL}")


COMMAND = Command(
    "sweep",
    main,
    """
    stackgen sweep --config configs/sweeps/ddpm.yaml --parallel 2
    stackgen sweep --config configs/sweeps/ddpm.yaml --run_cap 60 --out runs/sweeps/longer
    stackgen sweep --config configs/sweeps/ddpm.yaml --export_wandb > sweep.yaml
    """,
    settings={"sweep": Sweep},
    reports=True,
    flags={"export_wandb": "Print the file for `wandb sweep` instead of running it."},
    interpolation=False,  # `${args}` of a sweep file is for W&B
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
