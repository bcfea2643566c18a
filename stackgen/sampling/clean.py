"""What is delivered is clean: blocks that were put into each other, or into the air, are delivered as they settled."""

from __future__ import annotations

from collections.abc import Sequence

from stackgen.protocols import StabilityChecker, Verdict
from stackgen.stack import Stack


def as_settled(stacks: Sequence[Stack], checker: StabilityChecker) -> list[tuple[Stack, Verdict]]:
    """Let stacks settle, and judge those that stand once more, where their blocks then lie.

    Args:
        stacks: As they were proposed.
        checker: Says which stand, and where their blocks come to rest.

    Returns:
        Each stack as it settled, with the verdict on that; as it was, with its first verdict, where it falls.
    """
    verdicts = checker.check_all(stacks)
    standing = iter(checker.check_all([verdict.settled for verdict in verdicts if verdict.stable]))
    return [
        (verdict.settled, next(standing)) if verdict.stable else (stack, verdict)
        for stack, verdict in zip(stacks, verdicts, strict=True)
    ]
