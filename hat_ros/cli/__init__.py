"""The command line ``hat``. One file per group of commands; heavy imports happen inside the commands.

Exit codes: 0 done, 1 the run failed, 2 bad input, 130 stopped by Ctrl-C, 143 by SIGTERM. An error that the user can put
right is one sentence on stderr; a traceback is a bug.
"""

from __future__ import annotations

import argparse
import errno
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from hat_ros import __version__
from hat_ros.cli import analyse, bench, campaign, check, config, data, run, system, train
from hat_ros.errors import HatError, InputError, RunError

EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143
# Not what a program can foresee: rights, read-only and full disks.
_OF_THE_MACHINE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT)

_EPILOG = """\
examples:
  hat replay bags/demo --out out/demo          a recorded bag through the five-node ROS graph
  hat track bags/demo --out out/track          the same in this process, no ROS needed
  hat import sequence CLIP --out bags/clip     a folder of images to a bag
  hat bench CLIP CLIP --out out/bench          several methods over several clips, one table
  hat campaign CAD --out out/campaign          random clips of a CAD model: what share is found
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="hat",
        description="Hypothesis-Anchored Tracking: causal monocular 6-DoF pose of an uncooperative spacecraft.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for group in (run, data, check, analyse, bench, campaign, train, config, system):
        group.add_commands(commands)
    return parser


class _Terminated(KeyboardInterrupt):
    """SIGTERM, taken as Ctrl-C is: what was done is kept, and child processes are ended."""


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Within, the first SIGTERM raises :class:`_Terminated`, and later ones do not disturb the tidying up."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise _Terminated

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    parsed = build_parser().parse_args(arguments)
    try:
        with _sigterm_interrupts():
            return parsed.command(parsed) or 0
    except HatError as error:
        print(f"hat: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except ModuleNotFoundError as error:  # a checkout that is not installed
        if error.name is None or error.name.split(".")[0] == "hat_ros":
            raise
        print(f"hat: the package '{error.name}' is missing: run `make install` or `pip install .`", file=sys.stderr)
        return InputError.exit_code
    except KeyboardInterrupt as error:
        terminated = isinstance(error, _Terminated)
        print(
            f"hat: stopped by {'SIGTERM' if terminated else 'Ctrl-C'}; what was done is in --out or in the .partial "
            f"folder beside it, if the command had begun one",
            file=sys.stderr,
        )
        return EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
    except BrokenPipeError:  # `hat ... | head`
        sys.stderr.close()
        return 1
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            print(f"hat: '{str(error.filename)[:80]}...': {error.strerror}: give a shorter path", file=sys.stderr)
            return InputError.exit_code
        if error.errno not in _OF_THE_MACHINE or error.filename is None:
            raise
        print(f"hat: {error.filename}: {error.strerror}: choose a place that can be read and written", file=sys.stderr)
        return RunError.exit_code


if __name__ == "__main__":
    sys.exit(main())
