"""The one executable: a table of verbs, and the one place where an error becomes a line.

Standard library only, so that `stackgen --help` answers at once; a verb's module is imported when it runs.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TextIO

from stackgen.errors import StackgenError, Terminated, printable

BAD_INPUT, BUG, INTERRUPTED, UNREAD, TERMINATED = 2, 70, 130, 141, 143


class Verb(NamedTuple):
    """A row of the table.

    Args:
        module: Module with a function `run(verb, argv) -> int | None`.
        help: Description of the verb in one line.
    """

    module: str
    help: str


VERBS: dict[str, Verb] = {
    "sample": Verb("stackgen.commands.sample", "turn silhouettes into stacks that stand"),
    "check": Verb("stackgen.commands.check", "simulate the structures of a file: which stand, which fall"),
    "show": Verb("stackgen.commands.show", "draw the structures of a file, as a picture and in 3-D"),
    "studio": Verb("stackgen.commands.studio", "draw silhouettes in the browser, and watch them become structures"),
    "capture": Verb(
        "stackgen.commands.capture", "find the silhouette in a drawing, a photo of a sketch or a depth frame"
    ),
    "build": Verb("stackgen.commands.build", "build a structure with a UR5 and parallel jaws, simulated or real"),
    "generate": Verb("stackgen.commands.generate", "make a dataset by deconstruction"),
    "dataset": Verb("stackgen.commands.dataset", "verify, repair, describe, split or export a dataset"),
    "fit": Verb("stackgen.commands.fit", "train a model"),
    "validate": Verb("stackgen.commands.fit", "validate a model on the validation split"),
    "test": Verb("stackgen.commands.test", "measure weights or a sampler by the paper's protocol"),
    "predict": Verb("stackgen.commands.predict", "sample stacks for the scenes of a dataset"),
    "sweep": Verb("stackgen.commands.sweep", "try many settings of a training, locally or at W&B"),
    "prefer": Verb("stackgen.commands.prefer", "pair failures of a model with stacks that stand, to fine-tune it"),
    "report": Verb("stackgen.commands.report", "make the paper's table with every row, and its plots"),
    "export": Verb("stackgen.commands.export", "turn a training checkpoint into weights with a card"),
    "mix": Verb("stackgen.commands.mix", "add up weights of one architecture, each with its share"),
    "completion": Verb("stackgen.commands.completion", "print a script that completes this command line in a shell"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; never raises, so that every error has one form.

    Args:
        argv: Arguments without the program's name; those of the process by default.

    Returns:
        The exit code: 0, what the verb answers (`check`: 1 if a stack falls), 2 for bad input, 130 when interrupted,
        143 when terminated, 141 when nobody reads the output, 70 for a bug of ours (with its traceback).
    """
    _mend_streams()
    with _sigterm_as_an_exception():
        try:
            return _run(list(sys.argv[1:] if argv is None else argv))
        except BrokenPipeError:
            return _unread()


def _run(arguments: list[str]) -> int:
    if arguments[:1] == ["help"] and len(arguments) > 1:
        arguments = [*arguments[1:], "--help"]
    verb, *rest = arguments or ["--help"]
    try:
        if verb in ("-h", "--help", "help"):
            print(usage())
            return _flushed(0)
        if verb in ("-V", "--version", "version"):
            print(f"stackgen {_version()}")
            return _flushed(0)
        if verb not in VERBS:
            return _complain("", _unknown(verb), BAD_INPUT)
        _check_environment()
        return _flushed(importlib.import_module(VERBS[verb].module).run(verb, rest))
    except SystemExit as exit_:  # argparse's --help and the like
        if _within(exit_, BrokenPipeError):  # rich says 1
            return _unread()
        return exit_.code if isinstance(exit_.code, int) else 0 if exit_.code is None else BAD_INPUT
    except KeyboardInterrupt as interrupt:
        _debug()
        word, code = ("terminated", TERMINATED) if _within(interrupt, Terminated) else ("interrupted", INTERRUPTED)
        return _complain(verb, f"{word}; {str(interrupt) or 'no half-written file is left behind'}", code)
    except BrokenPipeError:
        raise
    except Exception as error:  # noqa: BLE001 - the one place that turns errors into lines
        line = explain(error)
        if line is None:
            traceback.print_exc()
            return _complain(verb, "this is a bug of stackgen; please report the lines above", BUG)
        _debug()
        return _complain(verb, line, BAD_INPUT)


_LAUNCHED = (
    *("RANK", "LOCAL_RANK", "JSM_NAMESPACE_RANK", "WORLD_SIZE", "MASTER_PORT"),
    *("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NODEID", "SLURM_NTASKS"),
)


def _check_environment() -> None:
    """See that what launchers leave in the environment are numbers: Lightning reads them while it is imported."""
    for name in _LAUNCHED:
        value = os.environ.get(name, "0")
        if not value.isdecimal():
            raise StackgenError(f"the environment variable {name} must be a whole number, got {value!r:.60}; unset it")


def _within(error: BaseException | None, kind: type[BaseException]) -> bool:
    """Tell whether an error is of a kind, or was raised while one of that kind was answered."""
    while error is not None and not isinstance(error, kind):
        error = error.__cause__ or error.__context__
    return error is not None


def _mend_streams() -> None:
    """Give a process whose output was closed one that goes nowhere; letters that a terminal lacks come out escaped."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - for the rest of the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def _sigterm_as_an_exception() -> Iterator[None]:
    """Answer SIGTERM as Ctrl-C is answered: nothing is left half done."""

    def terminate(number: int, frame: object) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _unread() -> int:
    """End as others do whose reader has gone."""
    _abandon(sys.stdout)
    return UNREAD


def _abandon(stream: TextIO) -> None:
    """Lead a stream nowhere that cannot be written to: else Python complains once more at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def explain(error: BaseException) -> str | None:
    """Put an error that a user can mend in one line; None for a bug."""
    kinds = {kind.__name__ for kind in type(error).__mro__}
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        what = error.filename or "a file or the output"
        return f"disk full while writing {what}: free some space and run the command again"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{error.strerror or text}: {error.filename}" if error.filename else text
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("stackgen"):
        return f"the package {error.name!r} is missing here: pip install {error.name}"
    if isinstance(error, MemoryError) or "allocate memory" in text:
        return f"there is not enough memory: {text}" if text else "there is not enough memory"
    # By name: the command line does not import the packages that define them.
    if kinds & {"StackgenError", "ArgumentError", "MisconfigurationException"} or _is_refusal(error):
        return text
    # jsonargparse wraps what goes wrong in a constructor.
    return explain(error.__cause__) if error.__cause__ is not None else None


_REFUSING = ("lightning", "pytorch_lightning", "torch", "wandb", "optuna", "fsspec", "tensorboard")
"""Packages that are handed settings of a user's as they are."""


def _is_refusal(error: BaseException) -> bool:
    """Tell whether a package refused what it was given, by an error that it raised itself and on purpose."""
    if not isinstance(error, ValueError | TypeError | RuntimeError | ImportError) or error.__traceback__ is None:
        return False
    last = traceback.extract_tb(error.__traceback__)[-1]
    package = last.filename.rpartition("site-packages")[2].replace("\\", "/").strip("/").partition("/")[0]
    return package in _REFUSING and (last.line or "").startswith("raise ")


def usage() -> str:
    """Write the table, for `stackgen --help`."""
    width = max(map(len, VERBS))
    rows = [f"  {name:<{width}}  {verb.help}" for name, verb in VERBS.items()]
    return "\n".join(
        [
            "usage: stackgen VERB ... | stackgen VERB --help | stackgen --version",
            "",
            "Stable block structures from silhouettes.",
            "",
            *rows,
            "",
            "example: stackgen sample examples/silhouettes/arch.png --num_samples 3 --out out/arch",
        ]
    )


def _unknown(verb: str) -> str:
    near = difflib.get_close_matches(verb, VERBS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(VERBS)}"
    return f"unknown verb {verb!r}: {hint}"


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("stackgen")
    except PackageNotFoundError:
        return "(not installed)"


def _flushed(code: int | None) -> int:
    """Flush here, where what goes wrong is still caught."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _abandon(sys.stdout)
        return _complain("", f"the output cannot be written: {error.strerror}", BAD_INPUT)
    return code or 0


def _complain(verb: str, message: str, code: int) -> int:
    """Say what is wrong in one line; what is written to a terminal cannot move its cursor."""
    line = f"stackgen{' ' if verb else ''}{verb}: {message.removeprefix(f'{verb}: ')}"
    with contextlib.suppress(OSError):
        print(printable(line), file=sys.stderr)
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        return code
    _abandon(sys.stdout)
    return code


def _debug() -> None:
    """Print the traceback behind a line, if STACKGEN_DEBUG=1 asks for it."""
    if os.environ.get("STACKGEN_DEBUG"):
        traceback.print_exc()


if __name__ == "__main__":
    sys.exit(main())
