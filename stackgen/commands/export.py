"""stackgen export: turn a training checkpoint into weights that can be given away."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.output import wrote
from stackgen.commands.parsing import Command, Files


def main(checkpoint: Path, out: Path, half: bool = False) -> None:
    """Write the weights of a checkpoint as safetensors, with a JSON card beside them.

    Args:
        checkpoint: Checkpoint of `stackgen fit`, or the folder of a run.
        out: File to write, ending in .safetensors; the card gets the same name with .json.
        half: Whether to store matrices as 16-bit floats, which halves the size.
    """
    from stackgen.models.weights import export_checkpoint, last_checkpoint  # loads torch, which --help does without

    export_checkpoint(last_checkpoint(checkpoint) if checkpoint.is_dir() else checkpoint, out, half=half)
    wrote(out, out.with_suffix(".json"))


COMMAND = Command(
    "export",
    main,
    """
    stackgen export runs/ddpm-small/version_0/checkpoints/last.ckpt --out ddpm-small.safetensors
    stackgen export runs/ddpm-small --out ddpm-small.safetensors
    stackgen export runs/tran-reg --out tran-reg.safetensors --half
    """,
    reports=True,
    flags={"half": "Store matrices as 16-bit floats, which halves the size."},
    files=Files("checkpoint", "CHECKPOINT", "Checkpoint (.ckpt) of `stackgen fit`, or the folder of a run."),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
