"""fit, validate, test and predict: Lightning's verbs, with a folder of its own for each run."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("JSONARGPARSE_DEPRECATION_WARNINGS", "off")  # Lightning 2.6 calls what jsonargparse 5 drops
os.environ.setdefault("WANDB_SILENT", "true")

import torch
import yaml
from jsonargparse import ArgumentParser, Namespace, set_parsing_settings
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.cli import ArgsType, LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger

from stackgen.commands.parsing import CONFIG_FLAGS, HelpFormatter, epilog, option_values, own_sections, parse
from stackgen.commands.test import WeightsUnderTest, run_protocol, write_predictions
from stackgen.data.datamodule import TESTSET, StackDataModule
from stackgen.data.provenance import warn_of_other_physics
from stackgen.data.shards import manifest_sha256
from stackgen.errors import StackgenError
from stackgen.io.files import write_atomically
from stackgen.io.provenance import code_version
from stackgen.models.module import CHECKPOINT_KEY
from stackgen.models.weights import last_checkpoint, resolve_weights
from stackgen.protocols import StabilityChecker
from stackgen.sim.physics import Physics
from stackgen.training.callbacks import SampleQuality, Throughput
from stackgen.training.plots import CheckpointArtifact, StepFigures, log_configuration
from stackgen.training.runs import RUNS, config_of, new_run
from stackgen.training.sweeps.telling import TellSweep, in_a_sweep

EXAMPLES = {
    "fit": """
stackgen fit --config configs/model/ddpm-small.yaml --data.path data/paper
stackgen fit --config configs/model/ddpm-small.yaml --data.path data/paper --ckpt_path last""",
    "validate": "stackgen validate --ckpt_path runs/ddpm-small/version_0/checkpoints/last.ckpt",
    "test": "stackgen test\nstackgen test --model.weights runs/ddpm-small/version_0/checkpoints/last.ckpt",
    "predict": "stackgen predict --model.weights runs/ddpm-small/version_0/checkpoints/last.ckpt",
}

Dashboard = Literal["wandb", "wandb-offline", "tensorboard", "none"]

_FOLDER = "STACKGEN_RUN_FOLDER"  # tells the processes that the first one starts where it writes
_RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "SLURM_PROCID")
"""What launchers number processes or machines by; all are 0, where they are set, for the first process alone."""


def run(verb: str, argv: Sequence[str]) -> None:
    """Parse, build and run one of Lightning's verbs."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for a class_path of the user's own
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)  # else `${...}` starts at the subcommand
    for chatty in ("lightning.pytorch", "lightning.fabric"):  # seeds, devices and advertisements
        logging.getLogger(chatty).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", ".*treespec, LeafSpec.*", FutureWarning)  # Lightning calls what PyTorch renames
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        _command_line(StackgenCLI, [verb, *own_sections(verb, argv)])
    except SystemExit as stop:  # Lightning answers Ctrl-C by exit(1)
        if not isinstance(stop.__context__, KeyboardInterrupt):
            raise
        raise KeyboardInterrupt("go on with --ckpt_path last" if verb == "fit" else "") from None
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        raise StackgenError(
            "the checkpoint does not fit the model of the configuration: give its own config.yaml"
        ) from error
    finally:
        signal.signal(signal.SIGINT, interrupt)  # Lightning leaves it ignored


def parser_of(verb: str) -> ArgumentParser:
    """The parser of one of Lightning's verbs, to be looked at."""
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
    kind(
        LightningModule,
        StackDataModule,
        subclass_mode_model=True,
        auto_configure_optimizers=False,
        seed_everything_default=0,
        trainer_defaults={"default_root_dir": str(RUNS)},
        parser_kwargs=_parser_options(),
        save_config_callback=SaveRun,
        args=arguments,
    )


class StackgenCLI(LightningCLI):
    """Lightning's command line with run folders, `--ckpt_path last` and errors of one line."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's verbs, and which of their arguments are not options."""
        verbs = LightningCLI.subcommands()
        return {**verbs, "predict": verbs["predict"] | {"return_predictions"}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add what is ours: the run's name."""
        parser.add_argument(
            "--name",
            type=str,
            default="run",
            help="Of the run; its files go to NAME/VERB_N in trainer.default_root_dir.",
        )
        parser.add_argument(
            "--dashboard",
            type=Dashboard,
            default="wandb",
            help="Where fit's curves and pictures go, beside metrics.csv: wandb is offline without WANDB_API_KEY.",
        )

    def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
        """Parse; find a checkpoint's configuration beside it, and the checkpoint that `last` means."""
        assert isinstance(args, list)
        verb, *rest = args
        rest = _complete(verb, rest)
        self.config = parse(parser, verb, [verb, *rest], self._parser(verb))
        config = self.config[verb]
        if config.get("model") is None:
            raise StackgenError(f"no model: give one, e.g. stackgen {verb} --config configs/model/ddpm-small.yaml")
        if config.ckpt_path is not None and _is_protocol(str(config.model.class_path)):
            raise StackgenError(f"{verb}: the model says which weights; give --ckpt_path without a configuration")
        root = Path(config.trainer.default_root_dir)
        if config.ckpt_path == "last":
            config.ckpt_path = str(last_checkpoint(root / config.name))
        elif config.ckpt_path is not None:
            _check_checkpoint(Path(config.ckpt_path))

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Make the run's folder, once model and data are there; keep logs and checkpoints in it."""
        verb, config = str(self.subcommand), self._get(self.config_init, "trainer")
        self.folder: Path | None = None
        given: list[Callback] = [config.callbacks] if isinstance(config.callbacks, Callback) else config.callbacks or []
        if not config.fast_dev_run:
            if verb in ("fit", "validate"):
                manifest = self.datamodule.manifest  # a mistake in the path must not leave an empty run behind
                if _is_first_process():
                    made = manifest.get("physics")
                    here = Physics.of_world(made).to_json()
                    warn_of_other_physics(f"dataset {self.datamodule.path}", made, here)
            kind = "version" if verb == "fit" else verb
            self.folder = _run_folder(self._get(self.config, "name"), Path(config.default_root_dir), kind)
            self.save_config_kwargs = {"folder": self.folder}
            if config.logger in (None, True):
                dashboard: Dashboard = self._get(self.config, "dashboard") if verb == "fit" else "none"
                kwargs["logger"] = _loggers(self.folder, dashboard)
            if verb == "fit":
                kwargs["callbacks"] = _watched(given)
                if config.enable_checkpointing is not False:
                    kwargs["callbacks"] = _with_checkpoints(kwargs["callbacks"], self.folder)
        for callback in given:
            if isinstance(callback, SampleQuality) and callback.checker is None:
                callback.checker = _physics(self.datamodule)
        return super().instantiate_trainer(**kwargs)

    def test(self, model: LightningModule, datamodule: StackDataModule, **options: Any) -> None:
        """The paper's protocol for weights; a training module's own test for anything else."""
        if isinstance(model, WeightsUnderTest):
            run_protocol(self.trainer, model, datamodule, self.folder)
        else:
            self.trainer.test(model, datamodule=datamodule, **options)
            self._write_metrics()

    def predict(self, model: LightningModule, datamodule: StackDataModule, **options: Any) -> None:
        """Stacks of weights, written to files."""
        if not isinstance(model, WeightsUnderTest):
            raise StackgenError(
                "predict samples with weights: leave --model out and give --ckpt_path or --model.weights"
            )
        self.trainer.predict(model, datamodule=datamodule, return_predictions=False, **options)
        folder = self.trainer.strategy.broadcast(self.folder)
        if folder is not None:
            write_predictions(model.predictions, folder)

    def after_validate(self) -> None:
        """Leave the figures behind."""
        self._write_metrics()

    def _write_metrics(self) -> None:
        if self.folder is None or not self.trainer.is_global_zero:
            return
        path = self.folder / "metrics.json"
        if not path.exists():
            metrics = {name: float(value) for name, value in self.trainer.callback_metrics.items()}
            write_atomically(path, (json.dumps(metrics, indent=1) + "\n").encode())
        print(f"wrote {path}")


class SaveRun(SaveConfigCallback):
    """Writes down what made a run, also for its dashboards: its configuration; code, data and command in `run.json`.

    Args:
        parser: Of the verb.
        config: What it made of the command line.
        folder: Of the run, whatever its loggers are.
    """

    def __init__(self, parser: LightningArgumentParser, config: Namespace, folder: Path) -> None:
        super().__init__(parser, config, save_to_log_dir=False)
        self.folder = folder

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """On the first process, once the folder is there."""
        text = self.parser.dump(self.config, skip_none=False)
        write_atomically(self.folder / "config.yaml", text.encode())
        facts: dict[str, Any] = {"code": code_version(), "command": ["stackgen", *sys.argv[1:]]}
        data = getattr(trainer, "datamodule", None)
        if isinstance(data, StackDataModule):
            asked = stage in ("test", "predict")
            path, manifest = (data.test_path, data.test_manifest) if asked else (data.path, data.manifest)
            facts["dataset"] = {"path": path, "name": manifest["name"], "sha256": manifest_sha256(manifest)}
        write_atomically(self.folder / "run.json", (json.dumps(facts, indent=1) + "\n").encode())
        for logger in trainer.loggers:
            if not isinstance(logger, CSVLogger):
                log_configuration(logger, {**yaml.safe_load(text), "run": facts})


def _parser_options() -> dict[str, Any]:
    """Options of the parser and of each verb's."""
    common = {
        "exit_on_error": False,
        "parser_mode": "omegaconf+",
        "allow_abbrev": False,
        "formatter_class": HelpFormatter,
    }
    verbs = {verb: {**common, "epilog": epilog(example)} for verb, example in EXAMPLES.items()}
    return {**common, "prog": "stackgen", **verbs}


def _complete(verb: str, arguments: list[str]) -> list[str]:
    """Fill in what goes without saying.

    `test` and `predict` are about weights unless another model is given, and ask them about the frozen
    test set: those of a sampler, or of a block-list network, with which the shipped sampler is asked. For `fit` and
    `validate` the configuration lies beside a run's checkpoint.
    """
    for _, value in option_values(arguments, ("--ckpt_path", "--model.weights")):
        _check_binary(Path(value))
    given = [value for _, value in option_values(arguments, (*CONFIG_FLAGS, "--model"))]
    checkpoints = [value for _, value in option_values(arguments, ("--ckpt_path",))]
    frozen = ["--data.path", str(TESTSET), "--data.eval_batch_size", "64"]
    if given:
        return [*frozen, *arguments] if verb in ("test", "predict") and any(map(_is_protocol, given)) else arguments
    if verb in ("test", "predict"):
        weights = ["--model", f"{WeightsUnderTest.__module__}.WeightsUnderTest", *frozen]
        part = _part(checkpoints[-1]) if checkpoints else "weights"
        return [*weights, *(a.replace("--ckpt_path", f"--model.{part}", 1) for a in arguments)]
    found = [path for path in (config_of(Path(checkpoint)) for checkpoint in checkpoints) if path]
    if not found:
        return arguments
    saved = yaml.safe_load(found[-1].read_text())
    asked = [key for key in saved if key != "ckpt_path"] if verb == "fit" else ["name", "model", "data"]
    return ["--config", yaml.safe_dump({key: saved[key] for key in asked}), *arguments]


def _part(checkpoint: str) -> str:
    """The parameter of `WeightsUnderTest` that a checkpoint is for; whoever loads it says what is wrong with it."""
    from stackgen.models.weights import role_of

    path = resolve_weights(checkpoint)
    return "block_list_weights" if Path(path).is_file() and role_of(path) == "predictor" else "weights"


def _is_protocol(value: str) -> bool:
    """Whether a configuration (a file or its text) or a model's name is about weights under test."""
    try:
        content = yaml.safe_load(Path(value).read_text() if value.endswith((".yaml", ".yml")) else value)
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return False  # the parser will say so
    model = content.get("model", content) if isinstance(content, dict) else content
    name = model.get("class_path") if isinstance(model, dict) else model
    return str(name).rpartition(".")[2] == WeightsUnderTest.__name__


def _check_binary(path: Path) -> None:
    """Say in one line if a file of weights holds text: the parser would take it for the description of a sampler."""
    starts = {".ckpt": (b"PK", 0), ".safetensors": (b"{", 8)}
    if path.suffix not in starts or not path.is_file():
        return
    mark, at = starts[path.suffix]
    with path.open("rb") as file:
        if not file.read(at + len(mark)).endswith(mark):
            raise StackgenError(f"{path} holds no weights of stackgen, or is damaged")


def _check_checkpoint(path: Path) -> None:
    """Say in one line if a file is no checkpoint of a training; only tensors and plain values are read from it."""
    if not path.is_file():
        raise StackgenError(f"no checkpoint at {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:
        raise StackgenError(f"{path} is not a checkpoint of `stackgen fit`: {type(error).__name__}") from error
    if not isinstance(content, dict) or CHECKPOINT_KEY not in content:
        raise StackgenError(f"{path} is not a checkpoint of `stackgen fit`: it says nothing of its world")


def _is_first_process() -> bool:
    """Also before Lightning, which numbers the processes, is there to be asked."""
    return not any(int(os.environ.get(name, 0)) for name in _RANKS)


def _run_folder(name: str, root: Path, kind: str) -> Path:
    """A new folder, made by the first process of a distributed run; the others write nothing, or ask it first."""
    if not _is_first_process():
        return Path(os.environ.get(_FOLDER, root / name))
    folder = new_run(name, root, kind)
    os.environ[_FOLDER] = str(folder)
    return folder


def _loggers(folder: Path, dashboard: Dashboard) -> list[Logger]:
    """CSV, and what else was asked for; a trial of a sweep is watched by its sweep alone."""
    csv = CSVLogger(folder.parent.parent, folder.parent.name, folder.name)
    if dashboard == "none" or in_a_sweep():
        return [csv]
    if _is_first_process():
        _ = csv.experiment  # before others put files into its folder
    if dashboard == "tensorboard":
        return [csv, TensorBoardLogger(folder, "", "", default_hp_metric=False)]
    offline = dashboard == "wandb-offline" or not os.environ.get("WANDB_API_KEY")
    name = f"{folder.parent.name}-{folder.name}"
    wandb = WandbLogger(name, folder, project="stackgen", offline=offline)
    getattr(wandb, "_wandb_init", {}).pop("anonymous", None)  # wandb warns about it, whatever its value
    return [csv, wandb]


def _watched(callbacks: list[Callback]) -> list[Callback]:
    """The callbacks, with those that a dashboard lives on; in a sweep, with the one that tells it."""
    found = list(callbacks)
    kinds = (StepFigures, Throughput, CheckpointArtifact)
    found += [kind() for kind in kinds if not any(isinstance(c, kind) for c in found)]
    return [*found, TellSweep()] if in_a_sweep() else found


def _physics(data: StackDataModule) -> StabilityChecker | None:
    """The simulator, where it is installed: training does without it."""
    try:
        from stackgen.sim.checkers import SimulatorChecker
    except ModuleNotFoundError:
        return None
    return SimulatorChecker(Physics.of_world(data.manifest.get("physics")), data.catalogue)


def _with_checkpoints(callbacks: list[Callback], folder: Path) -> list[Callback]:
    """The callbacks, with one that keeps the last state if there is none that keeps any."""
    found = list(callbacks)
    if not any(isinstance(callback, ModelCheckpoint) for callback in found):
        found.append(ModelCheckpoint(folder / "checkpoints", save_last=True, save_on_exception=True))
    return found
