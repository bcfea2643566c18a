"""Where the curves and pictures of a training go: CSV and PNG files in its folder, and a dashboard.

Metrics go through Lightning's `log` to every logger there is; pictures go to wandb, to TensorBoard, and as PNG files
to the folder of the run.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import yaml

from stackgen._lightning import pl
from stackgen.errors import require, warn
from stackgen.viz.render import Picture, save_image

Dashboard = Literal["wandb", "wandb-offline", "tensorboard", "none"]


SECONDS = 20.0
"""How long wandb's server may take to answer before the curves stay here [s]."""


def require_dashboard(dashboard: Dashboard) -> None:
    """See that a dashboard is installed.

    Raises:
        StackgenError: If it is not; the line names the extra.
    """
    if dashboard == "tensorboard":
        require("tensorboard", "tensorboard")


def loggers(folder: Path, dashboard: Dashboard, first: bool = True) -> list[pl.loggers.Logger]:
    """Make the loggers of a run: CSV, and what was asked for.

    Args:
        folder: Folder of the run.
        dashboard: Where its curves go besides; wandb is offline without `WANDB_API_KEY`, and where its server refuses
            the key or does not answer.
        first: Whether this is the first process of the run.

    Raises:
        StackgenError: If TensorBoard is asked for and not installed.
    """
    require_dashboard(dashboard)
    csv = pl.loggers.CSVLogger(folder.parent.parent, folder.parent.name, folder.name)
    if dashboard == "none":
        return [csv]
    if first:
        _ = csv.experiment  # before others put files into its folder
    if dashboard == "tensorboard":
        return [csv, pl.loggers.TensorBoardLogger(folder, "", "", default_hp_metric=False)]
    if dashboard == "wandb-offline" or not os.environ.get("WANDB_API_KEY"):
        return [csv, _wandb(folder, offline=True)]
    online = _wandb(folder, offline=False)
    if not first:
        return [csv, online]
    from wandb.errors import Error

    try:
        _ = online.experiment  # asks the server
    except Error as error:
        reason = " ".join(str(error).split()).partition(" Consider ")[0]
        warn(f"wandb: {reason:.200}; the curves stay in {folder}, from where `wandb sync` uploads them")
        return [csv, _wandb(folder, offline=True)]
    return [csv, online]


def _wandb(folder: Path, offline: bool) -> pl.loggers.WandbLogger:
    import wandb

    name, settings = f"{folder.parent.name}-{folder.name}", wandb.Settings(init_timeout=SECONDS)
    mode: dict[str, Any] = {"mode": "offline"} if offline else {}
    logger = pl.loggers.WandbLogger(name, folder, project="stackgen", offline=offline, settings=settings, **mode)
    getattr(logger, "_wandb_init", {}).pop("anonymous", None)  # wandb warns about it, whatever its value
    return logger


class CheckpointArtifact(pl.Callback):
    """When a fit has ended, give its checkpoint to wandb as the artifact `model-RUN`: the best, or else the last.

    Offline, too, which Lightning's logger refuses: `wandb sync` uploads the file from the run's folder.
    """

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let the first process, which has all there is, give it."""
        keeper: Any = trainer.checkpoint_callback
        path = getattr(keeper, "best_model_path", "") or getattr(keeper, "last_model_path", "")
        if not trainer.is_global_zero or not path:
            return
        for logger in trainer.loggers:
            if isinstance(logger, pl.loggers.WandbLogger):
                import wandb

                artifact = wandb.Artifact(f"model-{logger.experiment.id}", "model", metadata={"file": Path(path).name})
                # immutable: the file itself is meant, no copy of it in a folder of wandb's that `sync` would need too
                artifact.add_file(str(Path(path).resolve()), name="model.ckpt", policy="immutable")
                logger.experiment.log_artifact(artifact)


def log_configuration(trainer: pl.Trainer, config: dict[str, Any]) -> None:
    """Show what a run was made with on its dashboard; TensorBoard has it among its texts."""
    logger: Any
    for logger in trainer.loggers:
        if isinstance(logger, pl.loggers.CSVLogger):
            continue
        logger.log_hyperparams(config)
        if hasattr(logger.experiment, "add_text"):
            text = yaml.safe_dump(config, sort_keys=False)
            logger.experiment.add_text("configuration", "".join(f"    {line}\n" for line in text.splitlines()))


def log_picture(trainer: pl.Trainer, name: str, picture: Picture) -> None:
    """Give a picture to every logger that takes any; a run's folder keeps it as NAME/STEP.png.

    Args:
        trainer: Trainer with the loggers and the step; on other processes than the first nothing happens.
        name: Name of the picture, such as `sample/scenes`.
        picture: (H, W, 3).
    """
    if not trainer.is_global_zero:
        return
    step = trainer.global_step
    logger: Any
    for logger in trainer.loggers:
        experiment = logger.experiment
        if hasattr(logger, "log_image"):  # wandb
            logger.log_image(name, [picture], step)
        elif hasattr(experiment, "add_image"):  # TensorBoard
            experiment.add_image(name, picture, step, dataformats="HWC")
        elif logger.log_dir:
            folder = Path(logger.log_dir) / "pictures" / name
            folder.mkdir(parents=True, exist_ok=True)
            save_image(folder / f"{step:06d}.png", picture)
