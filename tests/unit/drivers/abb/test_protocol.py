"""Lines: what is encoded can be decoded, everything else is a BadLine, and no bytes make the reader hang."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.abb.protocol import (
    ANGLE_WIDTH,
    ANSWERS,
    LONGEST,
    BadLine,
    Code,
    LineBuffer,
    StateReply,
    Verb,
    angle_text,
    checksum,
    decode,
    encode,
    number_text,
    numbers,
    parse_state,
    state_arguments,
    whole,
)
from drivers.errors import RobotError

PRINTABLE = "".join(chr(code) for code in range(33, 127) if chr(code) != "*")
WORDS = st.text(PRINTABLE, min_size=1, max_size=9)
ANGLES = st.floats(-400, 400)


@given(st.integers(0, 9999), st.sampled_from([*Verb, *Code]), st.lists(WORDS, max_size=6))
def test_a_line_comes_back(number: int, word: str, arguments: list[str]) -> None:
    data = encode(number, word, *arguments)
    assert data.isascii()
    assert len(data) <= LONGEST + 1 <= 80
    line = decode(data[:-1])
    assert (line.number, line.word, line.arguments) == (number, word, tuple(arguments))
    assert decode(data[:-1] + b"\r") == line


@pytest.mark.parametrize("arguments", [("a" * 75,), ("ä",), ("a*b",), ("",), ("\n",)])
def test_what_is_no_line_is_not_sent(arguments: tuple[str, ...]) -> None:
    with pytest.raises(BadLine):
        encode(1, Verb.INFO, *arguments)


def test_a_bad_line_is_an_error_of_the_robot() -> None:
    assert issubclass(BadLine, RobotError)


@given(st.integers(1, 9999), st.lists(WORDS, max_size=5), st.data())
def test_every_single_wrong_character_and_every_exchange_of_neighbours_is_found(number: int, arguments: list[str], data: st.DataObject) -> None:
    line = encode(number, Verb.GO, *arguments)[:-1]
    at = data.draw(st.integers(0, len(line) - 4))
    wrong = data.draw(st.integers(32, 126).filter(lambda code: code != line[at]))
    with pytest.raises(BadLine):
        decode(line[:at] + bytes([wrong]) + line[at + 1 :])
    if line[at] != line[at + 1] and at + 1 < len(line) - 3:
        with pytest.raises(BadLine):
            decode(line[:at] + bytes([line[at + 1], line[at]]) + line[at + 2 :])


def test_the_checksum_is_what_the_page_says() -> None:
    assert checksum("0007 J") == "E3"
    assert checksum("") == "00"
    value = 0
    for character in "0017 GO 12 0016 17.1887 3.00":
        value = (31 * value + ord(character)) % 251
    assert encode(17, Verb.GO, "12", "0016", "17.1887", "3.00")[-3:-1] == f"{value:02X}".encode()


@given(st.binary(max_size=200))
def test_any_bytes_are_a_line_or_a_bad_line(data: bytes) -> None:
    try:
        line = decode(data)
    except BadLine:
        return
    assert encode(line.number, line.word, *line.arguments)[:-1] == data.removesuffix(b"\r")


@settings(max_examples=300)
@given(st.lists(st.one_of(st.binary(max_size=120), st.sampled_from([b"\n", b"\r\n", encode(1, Verb.STATE), encode(2, Verb.STOP)])), max_size=12))
def test_a_buffer_cuts_any_stream_into_lines_and_stays_small(parts: list[bytes]) -> None:
    buffer, pieces, single = LineBuffer(), [], LineBuffer()
    for part in parts:
        pieces += buffer.feed(part)
        assert all(len(line) <= 2 * LONGEST + 130 for line in pieces)
    together = single.feed(b"".join(parts))
    good = [line for line in together if _is_good(line)]
    assert [line for line in pieces if _is_good(line)] == good
    assert len(buffer.feed(b"\n")) <= 1


def _is_good(data: bytes) -> bool:
    try:
        decode(data)
    except BadLine:
        return False
    return True


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_an_angle_has_four_decimals_at_least_and_nine_characters_at_most(degrees: float) -> None:
    if not math.isfinite(degrees) or abs(degrees) >= 999.9999:
        with pytest.raises(BadLine):
            angle_text(degrees)
        return
    text = angle_text(degrees)
    assert len(text) <= ANGLE_WIDTH
    assert len(text.partition(".")[2]) >= 4
    assert abs(float(text) - degrees) <= 0.51e-4
    if abs(degrees) < 99.99:
        assert abs(float(text) - degrees) <= 0.51e-5
    assert not text.startswith("-0.00000")


@given(st.integers(0, 999), st.lists(ANGLES, min_size=6, max_size=6), *[st.sampled_from(letters) for letters in ("RMDX", "ARFU", "01-", "NEGP-")])
def test_a_state_comes_back_and_always_fits_a_rapid_string(
    epoch: int, joints: list[float], motion: str, mode: str, motors: str, stop: str
) -> None:
    state = StateReply(epoch, tuple(joints), motion, mode, motors, stop)
    data = encode(9999, Code.STATE, *state_arguments(state))
    back = parse_state(decode(data[:-1]))
    assert (back.epoch, back.motion, back.mode, back.motors, back.stop) == (epoch, motion, mode, motors, stop)
    assert max(abs(a - b) for a, b in zip(back.joints_deg, joints, strict=True)) <= 0.51e-4


def test_the_longest_pose_fits() -> None:
    xyz = [number_text(-9999.999, 3)] * 3
    assert len(encode(9999, Code.POSE, *xyz, *[number_text(-0.999999, 6)] * 4)) <= 80


@given(st.lists(st.text(max_size=12), max_size=8), st.integers(0, 8))
def test_numbers_are_plain_and_as_many_as_they_should_be(texts: list[str], count: int) -> None:
    try:
        found = numbers(tuple(texts), count)
    except BadLine:
        return
    assert len(found) == count
    assert all(math.isfinite(value) for value in found)


@pytest.mark.parametrize("text", ["nan", "inf", "1e5", "0x10", "1_0", "", "-", "1.", "٣", "+1", " 1", "123456"])
def test_numbers_of_other_languages_are_refused(text: str) -> None:
    if text == "1.":
        assert numbers((text,), 1) == (1.0,)
        return
    with pytest.raises(BadLine):
        numbers((text,), 1)


@given(st.text(max_size=6))
def test_whole_numbers(text: str) -> None:
    try:
        found = whole(text, 9999)
    except BadLine:
        return
    assert 0 <= found <= 9999


@pytest.mark.parametrize("verb", list(Verb))
def test_every_request_has_an_answer_of_its_own(verb: Verb) -> None:
    assert [other for other in Verb if ANSWERS[other] is ANSWERS[verb]] == [verb]
    assert ANSWERS[verb] is not Code.ERROR


@pytest.mark.parametrize(
    "line",
    [
        b"0001 J 1 0 0 0 0 0 0 RA-\n",
        b"0001 J 1 0 0 0 0 0 RA--\n",
        b"0001 J 1000 0 0 0 0 0 0 RA--\n",
        b"0001 J 1 0 0 0 0 0 x RA--\n",
        b"0001 P 1 0 0 0 0 0 0 RA--\n",
    ],
)
def test_a_state_that_is_none(line: bytes) -> None:
    number, word, *arguments = line.decode().split()
    with pytest.raises(BadLine):
        parse_state(decode(encode(int(number), word, *arguments)[:-1]))
