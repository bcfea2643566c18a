"""Where the report keeps and finds answers, by the question they answer.

It looks in its own cache, then among the files that `stackgen test` left in the folder of runs. What answers another
question, be it only with other physics, is never taken.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from stackgen.errors import StackgenError, warn
from stackgen.evaluation.results import Evaluation, Question, read_evaluation, write_evaluation

PREFIX = "evaluation-"
"""How the names of the files begin."""

_CONDITIONS = ("physics", "test_set", "protocol")
"""Parts of a question: where they differ, results cannot be compared."""


class Store:
    """Answers that are kept.

    Args:
        cache: Folder of the report's own; made when it is needed.
        runs: Folder in which `stackgen test` left its runs.
    """

    def __init__(self, cache: Path, runs: Path) -> None:
        self.cache, self.runs = cache, runs

    def find(self, question: Question) -> tuple[Evaluation, Path] | None:
        """Find the answer to a question and its file, if there is one."""
        own = self._path(question)
        paths = [*([own] if own.exists() else []), *(p for p, asked in self._tests.items() if asked == question)]
        for path in paths:
            try:
                evaluation, answered = read_evaluation(path)
            except StackgenError as error:
                warn(str(error))
                continue
            if answered == question:
                return evaluation, path
        return None

    def left_out(self, question: Question) -> Iterator[tuple[Path, str]]:
        """Name tests of the same sampler under other conditions, and in what those differ."""
        for path, asked in self._tests.items():
            same = all(asked.get(part) == question[part] for part in ("sampler", "block_list"))
            if same and (remarks := other_conditions(question, asked)):
                yield path, "; ".join(remarks)

    def keep(self, evaluation: Evaluation, question: Question) -> None:
        """Put an answer into the cache.

        Raises:
            StackgenError: If it cannot be written.
        """
        write_evaluation(self._path(question), evaluation, question)

    def _path(self, question: Question) -> Path:
        return self.cache / f"{PREFIX}{key_of(question)}.json"

    @cached_property
    def _tests(self) -> dict[Path, Question]:
        """What each test was asked."""
        found = {}
        for path in sorted(self.runs.glob(f"*/test_*/{PREFIX}*.json")):
            try:
                found[path] = read_evaluation(path)[1]
            except StackgenError:
                continue  # a test of an older version, or one that was interrupted
        return found


def key_of(question: Question) -> str:
    """Give the short name of a question, from its content."""
    text = json.dumps(question, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def other_conditions(question: Question, other: Question) -> tuple[str, ...]:
    """Say under what other conditions another question was answered; empty if they are the same.

    >>> other_conditions({"physics": {"friction": 0.5}}, {"physics": {"friction": 0.4}})
    ('other physics: friction 0.4, not 0.5',)
    """
    apart = differences(*({part: q.get(part) for part in _CONDITIONS} for q in (question, other)))
    physics = [f"{path.removeprefix('physics.')} {theirs}, not {ours}"
               for path, (ours, theirs) in apart.items() if path.startswith("physics")]  # fmt: skip
    remarks = [f"other physics: {', '.join(physics)}"] if physics else []
    if "test_set" in apart:
        remarks.append(f"another test set: {str(apart['test_set'][1])[:12]}")
    if "protocol" in apart:
        remarks.append(f"another version of the protocol: {apart['protocol'][1]}")
    return tuple(remarks)


def differences(question: Question, other: Question) -> dict[str, tuple[Any, Any]]:
    """Find where two questions differ: the path of each value, with both.

    >>> differences({"seed": 0, "physics": {"friction": 0.5}}, {"seed": 0, "physics": {"friction": 0.4}})
    {'physics.friction': (0.5, 0.4)}
    """
    found: dict[str, tuple[Any, Any]] = {}
    for name in sorted(question.keys() | other.keys()):
        a, b = question.get(name), other.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found |= {f"{name}.{inner}": pair for inner, pair in differences(a, b).items()}
        elif a != b:
            found[name] = (a, b)
    return found
