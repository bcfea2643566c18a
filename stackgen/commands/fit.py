"""stackgen fit and validate: Lightning's command line, with a folder of its own for each run."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("JSONARGPARSE_DEPRECATION_WARNINGS", "off")  # Lightning 2.6 calls what jsonargparse 5 drops
os.environ.setdefault("WANDB_SILENT", "true")

from jsonargparse import ArgumentParser, Namespace, set_parsing_settings
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import ArgsType, LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from stackgen.commands.found_config import described, taken_from
from stackgen.commands.old_names import renew
from stackgen.commands.parsing import (
    CONFIG_FLAGS,
    blaming_values,
    epilog,
    option_values,
    own_sections,
    parse,
    parser_options,
)
from stackgen.data.datamodule import StackDataModule
from stackgen.errors import StackgenError
from stackgen.io.files import write_json
from stackgen.io.text import parse_yaml, read_text, to_yaml
from stackgen.models.weights import CHECKPOINT_KEY, last_checkpoint, load_checkpoint
from stackgen.protocols import StabilityChecker
from stackgen.sim.other_physics import warn_of_other_physics
from stackgen.sim.physics import Physics
from stackgen.training.callbacks import SampleQuality, StepMetrics, Throughput
from stackgen.training.checkpoints import KeepOnStop, keep_whole
from stackgen.training.divergence import StopIfDiverged
from stackgen.training.loggers import CheckpointArtifact, Dashboard, log_configuration, loggers, require_dashboard
from stackgen.training.monitors import CheckMonitors
from stackgen.training.runs import RUNS, config_of, describe_run, drop_run_without, is_first_process, new_shared_run
from stackgen.training.sweeps.telling import TellSweep, in_a_sweep

EXAMPLES = {
    "fit": """
stackgen fit --config configs/model/ddpm-small.yaml --data.path data/paper
stackgen fit --config configs/model/ddpm-small.yaml --data.path data/paper --ckpt_path last""",
    "validate": "stackgen validate --ckpt_path runs/ddpm-small/version_0/checkpoints/last.ckpt",
}
DESCRIPTIONS = {
    "fit": "Train a model; its checkpoints, curves and configuration go to a new folder in runs.",
    "validate": "Validate a model on the validation split; its metrics go to a new folder in runs.",
}
CHECKPOINTS = {
    "fit": "Checkpoint to resume from: a file, the folder of a run, or `last` for the newest of the runs of this name."
    " Without --config, the configuration beside it is used, as far as it names nothing but stackgen's own classes and"
    " local data.",
    "validate": "Checkpoint to validate: a file, or the folder of a run. Without --config, the configuration beside it"
    " is used, as far as it names nothing but stackgen's own classes and local data.",
}


def run(verb: str, argv: Sequence[str]) -> None:
    """Parse, build and run the verb."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for a class_path of the user's own
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)  # else `${...}` starts at the subcommand
    for chatty in ("lightning.pytorch", "lightning.fabric"):  # seeds, devices and advertisements
        logging.getLogger(chatty).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*treespec, LeafSpec.*", FutureWarning)  # Lightning calls what PyTorch renames
    interrupt = signal.getsignal(signal.SIGINT)
    StackgenCLI.made = None
    try:
        _command_line(StackgenCLI, [verb, *own_sections(verb, argv)])
    except SystemExit as stop:  # Lightning answers Ctrl-C by exit(1)
        if not isinstance(stop.__context__, KeyboardInterrupt):
            raise
        raise KeyboardInterrupt(_how_to_go_on(StackgenCLI.made) if verb == "fit" else "") from None
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        raise StackgenError(
            "the checkpoint does not fit the model of the configuration: give its own config.yaml"
        ) from error
    finally:
        signal.signal(signal.SIGINT, interrupt)  # Lightning leaves it ignored
        if StackgenCLI.made and sys.exc_info()[0] is not None:
            drop_run_without("checkpoints/*.ckpt" if verb == "fit" else "metrics.json", StackgenCLI.made)


def _how_to_go_on(folder: Path | None) -> str:
    """Say how a training continues that was stopped."""
    last = folder / "checkpoints" / "last.ckpt" if folder else None
    return f"the state is kept: go on with --ckpt_path {last}" if last and last.is_file() else "nothing is kept yet"


def parser_of(verb: str) -> ArgumentParser:
    """Make the parser of a verb, to be looked at."""
    made: list[StackgenCLI] = []

    class NothingRuns(StackgenCLI):
        def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
            made.append(self)
            raise StopIteration

    with contextlib.suppress(StopIteration):
        _command_line(NothingRuns, [verb])
    return made[0]._parser(verb)


def _command_line(kind: type[StackgenCLI], arguments: list[str]) -> None:
    """Parse, build and run."""
    common = parser_options("omegaconf+")
    verbs = {
        verb: {**common, "description": DESCRIPTIONS[verb], "epilog": epilog(example)}
        for verb, example in EXAMPLES.items()
    }
    kind(
        LightningModule,
        StackDataModule,
        subclass_mode_model=True,
        auto_configure_optimizers=False,
        seed_everything_default=0,
        trainer_defaults={"default_root_dir": str(RUNS)},
        parser_kwargs={**common, "prog": "stackgen", **verbs},
        save_config_callback=SaveRun,
        args=arguments,
    )


class StackgenCLI(LightningCLI):
    """Lightning's command line with run folders, `--ckpt_path last` and errors of one line."""

    made: Path | None = None
    """Folder of the run that this process has made."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """List the verbs, and which of their arguments are not options."""
        return {verb: skip for verb, skip in LightningCLI.subcommands().items() if verb in EXAMPLES}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add what Lightning does not have: the run's name and its dashboard."""
        for group in parser._action_groups:
            if "LightningModule" in (group.title or ""):
                group.title = "Model"
        parser.add_argument(
            "--name",
            type=str,
            default="run",
            help="Name of the run; its files go to NAME/version_N in trainer.default_root_dir, or NAME/validate_N.",
        )
        parser.add_argument(
            "--dashboard",
            type=Dashboard,
            default="wandb",
            help="Dashboard for curves and pictures, beside metrics.csv; wandb is offline without WANDB_API_KEY.",
        )

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        """Describe `--ckpt_path` as it is here."""
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        next(action for action in parser._actions if action.dest == "ckpt_path").help = CHECKPOINTS[subcommand]
        return parser

    def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
        """Parse; find a checkpoint's configuration beside it, and the checkpoint that `last` means."""
        assert isinstance(args, list)
        verb, *rest = args
        self.config = parse(parser, verb, [verb, *_with_saved_config(verb, rest)], self._parser(verb))
        config = self.config[verb]
        if config.get("model") is None:
            raise StackgenError(f"no model: give one, e.g. stackgen {verb} --config configs/model/ddpm-small.yaml")
        if config.ckpt_path == "last":
            config.ckpt_path = str(last_checkpoint(Path(config.trainer.default_root_dir) / config.name))
        elif config.ckpt_path is not None:
            config.ckpt_path = str(_checkpoint_of(config.ckpt_path))
        if config.ckpt_path is not None:
            _check_checkpoint(Path(config.ckpt_path))

    def instantiate_classes(self) -> None:
        """Make model, data and trainer; what a constructor cannot do with a value is the configuration's fault."""
        with blaming_values():
            super().instantiate_classes()

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Make the trainer, which knows what process this is, then the run's folder for its logs and checkpoints."""
        verb, config = str(self.subcommand), self._get(self.config_init, "trainer")
        given: list[Callback] = [config.callbacks] if isinstance(config.callbacks, Callback) else config.callbacks or []
        _check_trainer(config)
        self.folder: Path | None = None
        curves = verb == "fit" and not in_a_sweep()  # a trial is watched by its sweep alone
        dashboard: Dashboard = self._get(self.config, "dashboard") if curves else "none"
        own_loggers = not config.fast_dev_run and config.logger in (None, True)
        if own_loggers:
            require_dashboard(dashboard)
            kwargs["logger"] = False  # until there is a folder
        if verb == "fit" and not config.fast_dev_run:
            kwargs["callbacks"] = _complete(given, keep=config.enable_checkpointing is not False)
        if _tasks_are_runs():
            plugins = config.plugins if isinstance(config.plugins, list) else [config.plugins]
            kwargs["plugins"] = [*filter(None, plugins), LightningEnvironment()]
        for callback in given:
            if isinstance(callback, SampleQuality) and callback.checker is None:
                callback.checker = _simulator(self.datamodule)
        made = self.datamodule.manifest.physics  # a mistake in the path must not leave an empty run behind
        trainer = super().instantiate_trainer(**kwargs)
        keep_whole(trainer)
        # What launchers left in the environment says nothing of this run.
        rank_zero_only.rank = trainer.global_rank  # type: ignore[attr-defined]
        if not config.fast_dev_run:
            if trainer.is_global_zero:
                warn_of_other_physics(f"dataset {self.datamodule.dataset.path}", made, Physics.recorded(made).to_json())
            self.folder = self._open_folder(trainer, "version" if verb == "fit" else verb)
            if own_loggers:
                trainer.loggers = loggers(self.folder, dashboard, trainer.is_global_zero)
        return trainer

    def _open_folder(self, trainer: Trainer, kind: str) -> Path:
        """Make the run's folder, and tell it those who write into it."""
        name, runs = self._get(self.config, "name"), Path(trainer.default_root_dir)
        folder = new_shared_run(name, runs, kind, trainer.is_global_zero)
        StackgenCLI.made = folder if trainer.is_global_zero else None
        for callback in trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, SaveRun):
                callback.folder = folder
            elif isinstance(callback, OwnCheckpoints):
                callback.dirpath = str(folder / "checkpoints")
        return folder

    def after_validate(self) -> None:
        """Leave the metrics behind."""
        if self.folder is None or not self.trainer.is_global_zero:
            return
        path = self.folder / "metrics.json"
        numbers = {name: float(value) for name, value in self.trainer.callback_metrics.items()}
        # Of few scenes some metrics do not exist.
        write_json(path, {name: value if math.isfinite(value) else None for name, value in numbers.items()})
        print(f"wrote {path}")


_LEAST = {"check_val_every_n_epoch": 1, "accumulate_grad_batches": 1, "log_every_n_steps": 0, "gradient_clip_val": 0}


def _check_trainer(config: Namespace) -> None:
    """Refuse numbers that Lightning takes and then divides by."""
    for name, least in _LEAST.items():
        value = config.get(name)
        if value is not None and not value >= least:
            raise StackgenError(f"trainer.{name} must be at least {least}, got {value}")


def _tasks_are_runs() -> bool:
    """Tell whether Slurm's tasks are runs of their own: those of one run are started with --ntasks-per-node."""
    return os.environ.get("SLURM_NTASKS", "1") != "1" and "SLURM_NTASKS_PER_NODE" not in os.environ


class SaveRun(SaveConfigCallback):
    """Writes down what made a run, also for its dashboards: its configuration; code, data and command in `run.json`.

    Args:
        parser: Parser of the verb.
        config: What it made of the command line.
    """

    folder: Path
    """Folder of the run, whatever its loggers are; set once it is there."""

    def __init__(self, parser: LightningArgumentParser, config: Namespace) -> None:
        super().__init__(parser, config, save_to_log_dir=False)

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write, on the first process, once the folder is there."""
        text = self.parser.dump(self.config, skip_none=False)
        data = getattr(trainer, "datamodule", None)
        facts = describe_run(self.folder, text, data.dataset if isinstance(data, StackDataModule) else None)
        log_configuration(trainer, {**parse_yaml(text, "the configuration"), "run": facts})


def _with_saved_config(verb: str, arguments: list[str]) -> list[str]:
    """Put the configuration that lies beside a run's checkpoint in front, where no other was given."""
    if option_values(arguments, (*CONFIG_FLAGS, "--model")):
        return arguments
    checkpoints = [_checkpoint_of(value) for _, value in option_values(arguments, ("--ckpt_path",))]
    found = [path for path in map(config_of, checkpoints) if path]
    if not found:
        return arguments
    typed = {argument.partition("=")[0].removeprefix("--") for argument in arguments if argument.startswith("--")}
    sections = ("seed_everything", "name", "dashboard", "model", "data", "trainer")
    saved = parse_yaml(renew(read_text(found[-1])), found[-1])
    taken = taken_from(saved, found[-1], typed, sections if verb == "fit" else ("name", "model", "data"))
    if is_first_process():
        print(described(taken, found[-1]), file=sys.stderr)
    return ["--config", to_yaml(taken), *arguments]


def _checkpoint_of(value: str) -> Path:
    """Find the checkpoint that `--ckpt_path` means: a file, or the last one of a run's folder."""
    return last_checkpoint(Path(value)) if Path(value).is_dir() else Path(value)


def _check_checkpoint(path: Path) -> None:
    """Say in one line if a file is no checkpoint of a training; only tensors and plain values are read from it."""
    if CHECKPOINT_KEY not in load_checkpoint(path):
        raise StackgenError(f"{path} is not a checkpoint of `stackgen fit`: it says nothing of its world")


class OwnCheckpoints(ModelCheckpoint):
    """Keeps the last state in the folder of the run."""


def _complete(callbacks: list[Callback], keep: bool) -> list[Callback]:
    """Add the callbacks that a dashboard lives on, or a sweep, and one that keeps the last state if none keeps any.

    Args:
        callbacks: Those of the configuration.
        keep: Whether any state is kept.
    """
    found = list(callbacks)
    for kind in (StepMetrics, Throughput, CheckpointArtifact, StopIfDiverged, KeepOnStop, CheckMonitors):
        if not any(isinstance(callback, kind) for callback in found):
            found.append(kind())
    if in_a_sweep():
        found.append(TellSweep())
    if keep and not any(isinstance(callback, ModelCheckpoint) for callback in found):
        found.append(OwnCheckpoints(save_last=True, save_on_exception=True))
    return found


def _simulator(data: StackDataModule) -> StabilityChecker | None:
    """Make a simulator with the data's physics, where it is installed: training does without it."""
    try:
        from stackgen.sim.checkers import SimulatorChecker
    except ModuleNotFoundError:
        return None
    return SimulatorChecker(Physics.recorded(data.manifest.physics))
