"""Every error is one line of bounded length, whatever of the input it quotes."""

from __future__ import annotations

import pickle

from hat_ros.errors import MAX_SENTENCE, FrameError


def test_a_sentence_that_quotes_a_long_input_keeps_its_ends():
    sentence = str(FrameError(f"camera_info.d must be finite, found {[0.1] * 5000}: calibrate again"))
    assert len(sentence) <= MAX_SENTENCE + 5
    assert sentence.startswith("camera_info.d must be finite") and sentence.endswith("calibrate again")


def test_line_breaks_of_an_input_become_blanks():
    assert str(FrameError("found 'a\nb\r\nc\u2028d'")) == "found 'a b c d'"


def test_a_short_sentence_stays_and_travels_between_processes():
    error = pickle.loads(pickle.dumps(FrameError("found 3")))
    assert isinstance(error, FrameError) and str(error) == "found 3"
