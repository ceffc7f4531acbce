"""The command line: verbs.py declares the verbs, and the module of that name does the work of each.

What answers `--help` and usage errors imports nothing heavy, for they must come at once on a small computer: the module of a
verb, with numpy, scipy and serial, is loaded when its options have been read. This package alone prints, and this file alone
turns errors into exit codes.
"""

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from importlib import import_module
from typing import Any, NoReturn

from .. import __version__
from ..errors import UsageError, UwbliteError
from ..report.printable import printable
from . import console, memory
from .interruption import interruptible
from .options import Verb
from .verbs import VERBS

_DESCRIPTION = """\
Maps from wheel odometry, ultra-wideband ranges to unknown anchors and a short-range 2D lidar.

examples:
  uwblite check run.log                 is the recording fit to be mapped?
  uwblite map run.log --out map/        map it
  uwblite evaluate map/ --truth t.tum   compare with the truth
"""

_LESS_MEMORY = "a coarser --resolution, --crop or a shorter recording needs less"

_EXIT_CODES = """\
exit codes:
  0    done
  1    error; one line on stderr says what, where and how to fix it
  2    wrong usage of the command line
  3    files are written, but the result should not be trusted; the reasons are named
  130  interrupted (Ctrl-C)

`uwblite VERB --help` shows the options of a verb, examples first.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default of this process, and return its exit code."""
    _open_streams()
    words = list(sys.argv[1:] if argv is None else argv)
    name = next((word for word in words if not word.startswith("-")), None)
    if name is None:
        return _answer_without_verb(words)
    if name not in VERBS:
        near = get_close_matches(name, VERBS, n=1)
        return _usage_error(f"unknown command {name!r}{f'; did you mean {near[0]!r}?' if near else ''}")
    words.remove(name)
    try:
        args = _parser_of(name, VERBS[name]).parse_args(words)
    except SystemExit as leave:
        return _flushed(int(leave.code or 0))
    return _run(name, args)


def _open_streams() -> None:
    """Send what would go to a closed stdout or stderr to nowhere: the work is done all the same.

    Their numbers are taken, so that no file gets one of them and, with it, what is meant for a stream.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def _answer_without_verb(words: list[str]) -> int:
    if "--version" in words:
        console.say(f"uwblite {__version__}")
        return _flushed(0)
    parser = _overview()
    if not words or "-h" in words or "--help" in words:
        console.write(sys.stdout if words else sys.stderr, parser.format_help())
        return _flushed(0 if words else 2)
    return _usage_error(f"{words[0]} needs a command before or after it")


def _overview() -> argparse.ArgumentParser:
    width = max(len(verb) for verb in VERBS)
    lines = [f"  {name:<{width}}  {verb.help}" for name, verb in VERBS.items()]
    return argparse.ArgumentParser(
        prog="uwblite",
        usage="uwblite VERB [options]   (uwblite --version, uwblite --help)",
        description=_DESCRIPTION,
        epilog="commands:\n" + "\n".join(lines) + "\n\n" + _EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=False,
    )


class _VerbParser(argparse.ArgumentParser):
    """A parser whose errors are short: what is wrong, what may have been meant, where the options stand."""

    def _print_message(self, message: str, file: Any = None) -> None:
        console.write(file or sys.stderr, message)

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        # argparse takes away what only separates options from names, and hands on a list where one word is meant.
        if action.option_strings and arg_strings == ["--"]:
            raise argparse.ArgumentError(action, "'--' is no value")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        """Say what is wrong and leave with code 2."""
        name, _, wrong = message.partition(": ")
        if name == "unrecognized arguments":
            word = wrong.split()[0].partition("=")[0]
            near = get_close_matches(word, self._option_string_actions, n=1)
            message = f"unknown option {word}" if word.startswith("-") else f"one argument too many: {word}"
            message += f"; did you mean {near[0]}?" if near else ""
        self.exit(2, f"{self.prog}: error: {printable(message)}\n`{self.prog} --help` shows the options, examples first\n")


def _parser_of(name: str, verb: Verb) -> argparse.ArgumentParser:
    parser = _VerbParser(
        prog=f"uwblite {name}",
        description=f"{verb.help}\n\n{verb.epilog.strip()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    # argparse takes "-0.05,0,0.6" for an option unless it is set that numbers may be joined by commas.
    parser._negative_number_matcher = re.compile(r"-[\d.][\d.,eE+-]*$")
    verb.add_arguments(parser)
    common = parser.add_argument_group("common options")
    common.add_argument("-q", "--quiet", action="store_true", help="no progress and no notes on stderr")
    common.add_argument("-v", "--verbose", action="count", default=0, help="say more on stderr; -vv for debugging")
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    common.add_argument("--version", action="version", version=f"uwblite {__version__}")
    return parser


def _run(name: str, args: argparse.Namespace) -> int:
    console.set_up(quiet=args.quiet, verbose=args.verbose)
    try:
        with interruptible() as interrupted:
            code = _carry_out(name, args, interrupted)
    except KeyboardInterrupt:
        # Between two lines, before the verb begins or after it has ended.
        code = console.fail("interrupted", 130)
    return _flushed(code)


def _flushed(code: int) -> int:
    """Return an exit code once all output is out; 1 where stdout could not take it."""
    return code if console.flush() else 1


def _carry_out(name: str, args: argparse.Namespace, interrupted: list[int]) -> int:
    """Run a verb and turn its errors into exit codes."""
    try:
        with warnings.catch_warnings():
            if not args.debug:
                # numpy's remarks on overflows say nothing to a user; what comes of them is in a message of ours.
                warnings.simplefilter("ignore", RuntimeWarning)
            with memory.within_limits() if VERBS[name].matrices else nullcontext():
                return int(import_module(f".{name.replace('-', '_')}", __name__).run(args))
    except KeyboardInterrupt:
        return console.fail("interrupted", 130)
    except Exception as error:
        if interrupted and not isinstance(error, UwbliteError | MemoryError | OSError):
            return console.fail("interrupted", 130)
        code, text = failure(error)
        return console.fail(text, code, trace=args.debug)


def failure(error: BaseException) -> tuple[int, str]:
    """Return the exit code that an error means, and what is said of it."""
    if isinstance(error, UwbliteError):
        return 2 if isinstance(error, UsageError) else 1, str(error)
    # A library that does not fit is an ImportError; one that is absent is a ModuleNotFoundError.
    unfit = isinstance(error, ImportError) and not isinstance(error, ModuleNotFoundError) and memory.shell_limits()
    if isinstance(error, MemoryError) or unfit:
        return 1, f"out of memory; {error if isinstance(error, memory.NoRoom) else _LESS_MEMORY + memory.allowed()}"
    if isinstance(error, OSError):
        return 1, console.os_error_text(error)
    if isinstance(error, ImportError):
        return 1, f"a library could not be loaded: {error}; is the installation whole?"
    return 1, f"internal error: {type(error).__name__}: {error} (please report it; --debug shows where)"


def _usage_error(text: str) -> int:
    console.write(sys.stderr, f"uwblite: error: {printable(text)}\nuwblite --help lists the commands\n")
    return _flushed(2)
