"""The one error family of the package.

Everything that a user can put right raises a subclass of :class:`HatError` whose message is one sentence that names
the field, what was found, and what to do. The command line catches the family once, prints the sentence to stderr
and exits with :attr:`HatError.exit_code`; nothing else is caught there, so a traceback always means a bug of ours.
"""

from __future__ import annotations

MAX_SENTENCE = 1800


class HatError(Exception):
    """Base of all errors that the user can put right.

    Args:
        sentence: what was wrong. Inputs are quoted in it, so line breaks become blanks, and of a long one the middle is
            left out: the field stands at its beginning, the advice at its end.
    """

    exit_code = 1

    def __init__(self, sentence: str) -> None:
        line = " ".join(sentence.splitlines())
        half = MAX_SENTENCE // 2
        super().__init__(line if len(line) <= MAX_SENTENCE else f"{line[:half]} ... {line[-half:]}")


class InputError(HatError):
    """Base of errors caused by what was given to us: exit code 2."""

    exit_code = 2


class UsageError(InputError):
    """The command line asks for something that does not exist or contradicts itself."""


class ConfigError(InputError):
    """A configuration holds an unknown key, a wrong type or a value out of range."""


class FrameError(InputError):
    """A camera frame or its camera_info is malformed: size, encoding, stamp or calibration."""


class CandidateError(InputError):
    """A pose hypothesis is not finite, not a rigid transform, or its score is not a number."""


class WireError(InputError):
    """A table message does not have exactly the columns that its topic promises."""


class BagError(InputError):
    """A bag is missing, truncated, altered, or lacks a topic that the run needs."""


class MeshError(InputError):
    """A CAD model cannot be read, is empty, not finite, or of absurd size."""


class DatasetError(InputError):
    """A data set's folder does not have the layout that its importer expects."""


class WeightsError(InputError):
    """A checkpoint is missing, altered, or does not have the tensors that its network needs."""


class MissingDependencyError(InputError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class RunError(HatError):
    """A run that started well could not go on: exit code 1."""


class StageTimeoutError(RunError):
    """A stage of the graph did not answer in ``graph.stage_timeout_s``."""
