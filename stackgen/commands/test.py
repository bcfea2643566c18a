"""stackgen test: the paper's protocol for weights, or for a sampler of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.asking import arguments_of, load_both, open_run
from stackgen.commands.output import tell, wrote
from stackgen.commands.parsing import Command
from stackgen.commands.progress_bar import after, progress_bar
from stackgen.errors import StackgenError
from stackgen.evaluation.parallel import simulating
from stackgen.evaluation.protocol import BATCH, Request, evaluate
from stackgen.evaluation.report.store import PREFIX
from stackgen.evaluation.requests import Method, question_of
from stackgen.evaluation.results import Evaluation, write_evaluation, write_metrics, write_scenes
from stackgen.evaluation.tables import list_table, metrics_table
from stackgen.io.provenance import code_version
from stackgen.io.text import read_json
from stackgen.sim.other_physics import warn_of_other_physics
from stackgen.training.runs import RUNS, dropped_if_failing


def main(
    subject: Method,
    config: str,
    ckpt_path: Path | None = None,
    test_set: str | None = None,
    num_samples: int = 3,
    seed: int = 0,
    predicted_lists: bool = True,
    method: str | None = None,
    limit: int | None = None,
    batch_size: int = BATCH,
    workers: int = 1,
    name: str = "run",
    runs: Path = RUNS,
) -> None:
    """Measure weights, or a sampler, by the paper's protocol on the frozen test set.

    Each scene is asked with its true block list and with the network's most likely one; every sample is simulated.
    `metrics.json`, a CSV of every sample and the configuration go to runs/NAME/test_N.

    Args:
        subject: Method that is tested.
        config: All options, as YAML.
        ckpt_path: Checkpoint or run folder to test: of a sampler, or of a block-list network, whose lists the shipped
            sampler is then asked with.
        test_set: Dataset whose test split is asked about; by default the frozen `testset-v1`.
        num_samples: Number of stacks sampled for each scene.
        seed: Seed of the sampler; the same seed and batch size give the same stacks.
        predicted_lists: Whether the network's block lists are measured too, beside the true ones.
        method: Name in the tables; by default the name of the weights.
        limit: Number of scenes to ask about, from the first; all by default.
        batch_size: Number of scenes sampled at once.
        workers: Number of processes that simulate.
        name: Name of the run.
        runs: Folder of all runs.
    """
    if workers < 1:
        raise StackgenError(f"--workers must be at least 1, got {workers}")
    loaded, scenes, dataset = load_both(subject, ckpt_path, test_set, limit)
    manifest = dataset.manifest
    facts = {"code": code_version(), "dataset": {"name": manifest.name, "sha256": manifest.sha256}}
    requests = loaded.requests(
        method, num_samples, seed, predicted_lists=predicted_lists, batch_size=batch_size, facts=facts
    )
    requests.append(Request.ground_truth(dataset.world, facts))
    folder = open_run(name, runs, "test", config, dataset)
    found: list[Evaluation] = []
    with dropped_if_failing(f"{PREFIX}*.json", folder), simulating(loaded.model.physics, workers) as checker:
        physics = checker.physics.to_json()
        learnt = (loaded.model.sampler.card.get("dataset") or {}).get("physics")
        warn_of_other_physics(f"dataset {dataset.path}", manifest.physics, physics)
        warn_of_other_physics(f"what {requests[0].method} learnt from", learnt, physics)
        with progress_bar("scenes", len(requests) * len(scenes)) as (advance, _):
            for number, request in enumerate(requests):
                try:
                    found.append(evaluate(request, scenes, checker, after(number * len(scenes), advance)))
                except KeyboardInterrupt:
                    raise KeyboardInterrupt(_how_to_go_on(number, len(requests), folder)) from None
                question = question_of(request, manifest.sha256, len(scenes), physics)
                kind = request.block_list if request.sampler else "ground-truth"
                write_evaluation(folder / f"{PREFIX}{kind}.json", found[-1], question)
    write_metrics(folder / "metrics.json", found)
    for evaluation in found:
        words = f"{evaluation.method} {evaluation.block_list}".lower()
        write_scenes(folder / f"scenes-{''.join(c if c.isalnum() else '-' for c in words)}.csv", evaluation)
    lists = list_table(found)
    tell(metrics_table(found), *([] if lists is None else [lists]), **read_json(folder / "metrics.json"))
    wrote(folder / "metrics.json")


def _how_to_go_on(done: int, parts: int, folder: Path) -> str:
    """Say what a test that was stopped leaves behind."""
    if not done:
        return "nothing is kept yet; the same command begins again"
    kept = f"{done} of {parts} parts are kept in {folder}, where `stackgen report` finds them"
    return f"{kept}; the same command begins again"


COMMAND = Command(
    "test",
    main,
    """
    stackgen test
    stackgen test --ckpt_path runs/ddpm-small/version_0/checkpoints/last.ckpt
    stackgen test --config configs/baselines/brute-force.yaml --limit 128 --workers 2
    """,
    settings={"subject": Method},
    reports=True,
    config="config",
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(arguments_of(verb, argv))
