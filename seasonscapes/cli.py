"""The entry of the command line: one verb, one result, and every failure told in one line.

Only the standard library is imported here, so that Ctrl-C is answered from the first moment; `seasonscapes.commands`
holds the application.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

from seasonscapes.commands.interruption import ignore_further_interruptions, interrupted, interruptible
from seasonscapes.freed_memory import keep_freed_memory


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Every failure is one line on stderr, and with ``--json`` one JSON object with the key ``error`` on stdout as well.
    ``SEASONSCAPES_DEBUG=1`` shows the traceback of any failure too.

    Parameters
    ----------
    arguments
        The words after the program's name; those of this process if omitted.

    Returns
    -------
    int
        Exit code: 0 for success; 2 for a mistake in the input, or files and memory that do not allow the work; 130 for
        an interruption; 1 for a fault of the program.
    """
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        # Before numpy is imported. No command has matrices that pay for BLAS's own threads: they wait busily for one
        # another, which made half of the processor time of short commands.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # No model here has plugins of Pydantic: it would read the metadata of every installed package in search of some.
        os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
        keep_freed_memory()
    # After a process's command only the interpreter's own end is left: Ctrl-C there ends it without a traceback.
    with interruptible(afterwards=signal.SIG_DFL if arguments is None else None):
        try:
            return _exit_code(tokens)
        except KeyboardInterrupt:
            return _told_interruption(tokens)


def run(tokens: Sequence[str]) -> None:
    """Run one command; exceptions pass through."""
    from seasonscapes.commands.application import run_verb
    from seasonscapes.commands.console import show_messages

    show_messages()
    run_verb(tokens)


def _exit_code(tokens: list[str]) -> int:
    """Run one command and tell its failure."""
    from seasonscapes.commands.console import ReaderGone
    from seasonscapes.commands.refusals import told
    from seasonscapes.errors import SeasonscapesError

    try:
        run(tokens)
    except ReaderGone:
        return 0
    except Exception as error:
        if interrupted():
            return _told_interruption(tokens)
        if isinstance(error, SeasonscapesError):
            return _refuse(tokens, str(error), error)
        if isinstance(error, (OSError, MemoryError)):
            return _refuse(tokens, told(error), error)
        return _refuse(tokens, _fault(error), error, code=1)
    return 0


def _told_interruption(tokens: list[str]) -> int:
    ignore_further_interruptions()
    return _refuse(tokens, "interrupted; finished files are whole, nothing half was left", None, code=130)


def _fault(error: Exception) -> str:
    """One line about an exception that nothing expected."""
    import traceback

    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if f"{os.sep}seasonscapes{os.sep}" in frame.filename] or list(frames)
    where = f"{os.path.basename(own[-1].filename)}:{own[-1].lineno}"
    return (
        f"{where}: {type(error).__name__}: {error}; this is a fault of seasonscapes: please report it with the traceback "
        "that SEASONSCAPES_DEBUG=1 shows"
    )


def _refuse(tokens: list[str], problem: str, error: BaseException | None, *, code: int = 2) -> int:
    """Tell a failure in one line, and return the exit code."""
    from seasonscapes.commands.console import ReaderGone, message, plain_line, print_record

    if error is not None and os.environ.get("SEASONSCAPES_DEBUG"):
        import traceback

        traceback.print_exception(error)
    line = plain_line(problem)
    try:
        if _asks_for_json(tokens):
            print_record({"error": line})
        message(f"seasonscapes: {line}")
    except (OSError, ReaderGone):
        return code  # nobody is left who could be told
    return code


def _asks_for_json(tokens: list[str]) -> bool:
    return any(token == "--json" or token.startswith("--json=") for token in tokens)
