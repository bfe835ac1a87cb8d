"""What decoders written in C complain of: they write to the standard error stream and go on."""

from __future__ import annotations

import os
import sys
import tempfile
from contextlib import contextmanager


@contextmanager
def words_on_stderr():
    """A list that holds, afterwards, one string: what was written to file descriptor 2 meanwhile."""
    said = []
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as stream:
        os.dup2(stream.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            stream.seek(0)
            said.append(stream.read().decode())
