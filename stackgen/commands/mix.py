"""stackgen mix: weights from others of one architecture, each with its share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stackgen.commands.output import wrote
from stackgen.commands.parsing import Command, Files


def main(weights: list[Path], out: Path, shares: list[float] | None = None, half: bool = False) -> None:
    """Add up weights of one architecture, each times its share, and write the sum as safetensors with a JSON card.

    The mean of weights that were tuned from common ancestors is often better than each of them; shares above 1 and
    below 0 go beyond tuned weights in the direction of their tuning.

    Args:
        weights: Weights to mix.
        out: File to write, ending in .safetensors; the card gets the same name with .json.
        shares: Share of each, in their order; all together are 1. Equal shares where left out.
        half: Whether to store matrices as 16-bit floats, which halves the size.
    """
    from stackgen.models.mixing import mix_weights  # loads torch, which --help does without
    from stackgen.models.weights import export_weights

    export_weights(*mix_weights(weights, shares), out, half=half)
    wrote(out, out.with_suffix(".json"))


COMMAND = Command(
    "mix",
    main,
    """
    stackgen mix runs/first runs/second --out mean.safetensors
    stackgen mix runs/tuned taught-small --shares '[1.5, -0.5]' --out further.safetensors --half
    """,
    reports=True,
    flags={"half": "Store matrices as 16-bit floats, which halves the size."},
    files=Files("weights", "WEIGHTS", "Weights to mix: names, .safetensors or .ckpt files, or run folders.", many=True),
)


def run(verb: str, argv: Sequence[str]) -> int | None:
    """Run the verb."""
    return COMMAND.run(argv)
