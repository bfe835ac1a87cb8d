"""The law of all readers: whatever comes in ends in a value or in one sentence.

``HAT_FUZZ_CASES`` is the number of cases of each reader, ``HAT_FUZZ_SEED`` the seed of them all, ``HAT_FUZZ_FIRST``
the case to begin with: the three together repeat one case.
"""

from __future__ import annotations

import logging
import os
import resource
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from hat_ros.errors import HatError

CASES = int(os.environ.get("HAT_FUZZ_CASES", "40"))
SEED = int(os.environ.get("HAT_FUZZ_SEED", "1"))
FIRST = int(os.environ.get("HAT_FUZZ_FIRST", "0"))
CASE_LIMIT_S = 10.0
MEMORY_LIMIT_KIB = 2**20
MESSAGE_LIMIT = 2000
SHOWN = 12


class Hang(BaseException):
    """The time limit of a case; no ``except Exception`` of a reader can hold it."""


def _on_alarm(_signal, _frame) -> None:
    raise Hang


def _fault(read: Callable[[bytes], object], data: bytes, ends: Counter, limit_s: float) -> str:
    """What is wrong with how the input ends; empty if nothing."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    text = ""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            read(data)
            ends["value"] += 1
        except HatError as error:
            ends["sentence"] += 1
            sentence = str(error)
            if not sentence or len(sentence) > MESSAGE_LIMIT or len(sentence.splitlines()) != 1:
                text = (
                    f"the message has {len(sentence)} characters, {sentence.count(chr(10))} breaks: {sentence!r:.300}"
                )
        except Hang:
            text = f"not done after {limit_s:g} s"
        except BaseException as error:  # whatever it is, it is the finding
            if isinstance(error, KeyboardInterrupt):
                raise
            text = "".join(traceback.format_exception(error, limit=-4))
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
    numeric = [item for item in said if issubclass(item.category, RuntimeWarning)]
    if numeric and not text:
        text = f"warning {numeric[0].message} ({numeric[0].filename}:{numeric[0].lineno})"
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if grown > MEMORY_LIMIT_KIB and not text:
        text = f"the process grew by {grown // 1024} MiB"
    return text


@pytest.fixture
def fuzz(tmp_path_factory, record_property):
    """``fuzz(reader, make, read)``: ``make(rng)`` gives the bytes of a case, ``read(bytes)`` is the reader.

    ``one_in`` makes a slow reader do only one case of so many, ``limit_s`` gives each of them more time.
    """

    def run(
        reader: str,
        make: Callable[[Random], bytes],
        read: Callable[[bytes], object],
        one_in: int = 1,
        limit_s: float = CASE_LIMIT_S,
    ) -> None:
        cases = max(1, CASES // one_in)
        folder: Path = tmp_path_factory.mktemp("offending")
        before, level = signal.signal(signal.SIGALRM, _on_alarm), logging.root.manager.disable
        logging.disable(logging.CRITICAL)
        faults, ends = [], Counter()
        try:
            for case in range(FIRST, FIRST + cases):
                data = make(Random(f"{SEED}/{reader}/{case}"))
                if fault := _fault(read, data, ends, limit_s):
                    path = folder / f"{reader}-{SEED}-{case}.bin"
                    path.write_bytes(data)
                    again = f"HAT_FUZZ_SEED={SEED} HAT_FUZZ_FIRST={case} HAT_FUZZ_CASES=1"
                    faults.append(f"reader {reader}, seed {SEED}, case {case} ({again}), input {path}:\n{fault}")
        finally:
            logging.disable(level)
            signal.signal(signal.SIGALRM, before)
        record_property(f"fuzz {reader}", dict(ends))
        peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(
            f"fuzz {reader}: {cases} cases, {ends['value']} values, {ends['sentence']} sentences, "
            f"{len(faults)} faults; memory of the process so far {peak_mib} MiB"
        )
        if faults:
            pytest.fail(f"{len(faults)} of {cases} cases\n" + "\n".join(faults[:SHOWN]), pytrace=False)

    return run
