"""What a person watches while a model trains, beside its losses: pictures, learning rate, gradient norm.

The figures go through Lightning's `log` to every logger there is; pictures go to wandb, to TensorBoard, and as
PNG files to the folder of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from stackgen._lightning import pl
from stackgen.errors import StackgenError
from stackgen.evaluation.protocol import Scene
from stackgen.geometry import silhouette
from stackgen.protocols import Verdict
from stackgen.stack import Stack
from stackgen.viz.render import FALLEN, Colour, Picture, save_image
from stackgen.world import PAPER_GRID, Grid, Mask

_SCALE = 2  # of the pictures' pixels to the silhouettes'
_ACROSS = 4  # scenes beside each other
_GAP, _CAPTION, _HEADS, _LETTERS = 8, 36, 122, 22  # [pixel]
_GOOD: Colour = (30, 130, 76)
_INK: Colour = (40, 42, 48)
_LIGHT: Colour = (238, 240, 244)


class StepMetrics(pl.Callback):
    """Logs `train/learning_rate` and `train/gradient_norm`, that of all gradients together before they are clipped.

    Args:
        every_n_steps: By default as often as the trainer logs.
    """

    def __init__(self, every_n_steps: int | None = None) -> None:
        if every_n_steps is not None and every_n_steps < 1:
            raise StackgenError(f"StepMetrics: every_n_steps must be at least 1, got {every_n_steps}")
        self.every_n_steps = every_n_steps

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: torch.optim.Optimizer
    ) -> None:
        """Look at the gradients, now that they are there."""
        every = self.every_n_steps or max(1, trainer.log_every_n_steps)  # type: ignore[attr-defined]
        if trainer.global_step % every:
            return
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients))) if gradients else torch.zeros(())
        figures = {"train/learning_rate": float(optimizer.param_groups[0]["lr"]), "train/gradient_norm": norm}
        pl_module.log_dict(figures, batch_size=1)


class CheckpointArtifact(pl.Callback):
    """When a fit has ended, gives its checkpoint to wandb as the artifact `model-RUN`: the best, or else the last.

    Offline, too, which Lightning's logger refuses: `wandb sync` uploads the file from the run's folder.
    """

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The first process has all there is."""
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


def silhouette_sheet(
    scenes: Sequence[Scene], stacks: Sequence[Stack], verdicts: Sequence[Verdict | None], grid: Grid = PAPER_GRID
) -> Picture:
    """One picture: for each scene its target, the silhouettes of the stack as generated and settled, the verdict.

    Dashboards show it a few hundred pixels wide: few scenes lie beside each other, the next ones below them.

    Args:
        scenes: What was asked for, one a column.
        stacks: A stack for each.
        verdicts: On each; None where there was no physics.
        grid: Of the silhouettes.
    """
    from PIL import Image, ImageDraw, ImageFont

    step = grid.image_size * _SCALE + _GAP
    band = 3 * step + _CAPTION
    across = min(len(scenes), _ACROSS)
    bands = -(-len(scenes) // _ACROSS)
    sheet = Image.new("RGB", (_HEADS + across * step, _GAP + bands * band), (255, 255, 255))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(_LETTERS)
    for number in range(3 * bands):
        head, y = ("target", "generated", "settled")[number % 3], _GAP + number // 3 * band + number % 3 * step
        pen.text((_GAP, y + step // 2), head, fill=_INK, font=font, anchor="lm")
    for number, (scene, stack, verdict) in enumerate(zip(scenes, stacks, verdicts, strict=True)):
        x, y = _HEADS + number % _ACROSS * step, _GAP + number // _ACROSS * band
        tone = FALLEN if verdict is not None and not verdict.stable else _INK
        masks = [(scene.silhouette, _INK), (silhouette(stack, grid, "front"), _INK)]
        if verdict is not None:
            masks.append((silhouette(verdict.settled, grid, "front"), tone))
            text, colour = ("stands", _GOOD) if verdict.stable else (f"{int(verdict.fell.sum())} fell", FALLEN)
            pen.text((x, y + 3 * step + _CAPTION // 2 - _GAP), text, fill=colour, font=font, anchor="lm")
        for row, (mask, ink) in enumerate(masks):
            sheet.paste(Image.fromarray(_coloured(mask, ink)), (x, y + row * step))
    return np.asarray(sheet)


def _coloured(mask: Mask, colour: Colour) -> Picture:
    picture = np.where(np.asarray(mask, bool)[..., None], np.array(colour), np.array(_LIGHT)).astype(np.uint8)
    return picture.repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)


def log_configuration(logger: Any, config: dict[str, Any]) -> None:
    """Show what a run was made with on its dashboard; TensorBoard has it among its texts."""
    logger.log_hyperparams(config)
    if hasattr(logger.experiment, "add_text"):
        text = yaml.safe_dump(config, sort_keys=False)
        logger.experiment.add_text("configuration", "".join(f"    {line}\n" for line in text.splitlines()))


def log_picture(trainer: pl.Trainer, name: str, picture: Picture) -> None:
    """Give a picture to every logger that takes any; a run's folder keeps it as NAME/STEP.png.

    Args:
        trainer: Whose loggers and step; on other processes than the first nothing happens.
        name: Such as `sample/scenes`.
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
