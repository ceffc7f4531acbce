"""Ways in which files are damaged: bytes, words, numbers, lines, ends, compression."""

import gzip

import numpy as np

Rng = np.random.Generator

WORDS = (
    b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e200", b"1e100", b"1e30", b"1e16", b"1e-300", b"1e400", b"-1", b"0",
    b"-0.0", b"9" * 30, b"2147483648", b"9223372036854775808", b"../../x", b"<script>", b"", b"\0", b"\xff\xfe",
    b"\x1b[31m", b"\xe2\x80\xae",
    b'"', b"'", b"[", b"]", b"=", b"=1+1", b"{", b"}", b"#", b"\n", b"\r", b"\r\n", b",", b",,", b" ", b"\t", b"1_0", b"0x1p3",
    b"\xd9\xa3", b"--5", b"+5", b"true", b"[[a]]", b"\xe9", b"A" * 5000, b"ODOM", b"999999999", b"1.5.2", b"1e", b".", b"-",
)  # fmt: skip
_BLANKS = b" ,\n=\t"


def damaged(whole: bytes, rng: Rng) -> bytes:
    """Return a file after one to six accidents; sometimes compressed, and then perhaps damaged once more."""
    for _ in range(min(int(rng.geometric(0.4)), 6)):
        whole = _ACCIDENTS[rng.integers(len(_ACCIDENTS))](whole, rng)
    if rng.random() < 0.05:
        whole = gzip.compress(whole, mtime=0)
        if rng.random() < 0.5:
            whole = _byte(whole, rng)
    return whole


def _place(whole: bytes, rng: Rng) -> int:
    return int(rng.integers(len(whole) + 1))


def _word(whole: bytes, rng: Rng) -> tuple[int, int]:
    """Return where a word begins and ends."""
    at = _place(whole, rng)
    start = max(whole.rfind(bytes([c]), 0, at) for c in _BLANKS) + 1
    return start, min((e for c in _BLANKS if (e := whole.find(bytes([c]), start)) >= 0), default=len(whole))


def _byte(whole: bytes, rng: Rng) -> bytes:
    at = _place(whole, rng)
    return whole[:at] + bytes([rng.integers(256)]) + whole[at + 1 :]


def _bit(whole: bytes, rng: Rng) -> bytes:
    at = _place(whole, rng)
    return whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :] if at < len(whole) else whole


def _replace(whole: bytes, rng: Rng) -> bytes:
    start, end = _word(whole, rng)
    return whole[:start] + WORDS[rng.integers(len(WORDS))] + whole[end:]


def _insert(whole: bytes, rng: Rng) -> bytes:
    at = _place(whole, rng) if rng.random() < 0.5 else _word(whole, rng)[0]
    return whole[:at] + WORDS[rng.integers(len(WORDS))] + whole[at:]


def _number(whole: bytes, rng: Rng) -> bytes:
    """Scale a number, or turn its sign: other units, other epochs, far places."""
    start, end = _word(whole, rng)
    try:
        value = float(whole[start:end])
    except ValueError:
        return whole
    factor = 10.0 ** float(rng.integers(-12, 25)) * (-1 if rng.random() < 0.3 else 1)
    return whole[:start] + repr(value * factor + float(rng.integers(0, 2))).encode() + whole[end:]


def _cut(whole: bytes, rng: Rng) -> bytes:
    first, last = sorted((_place(whole, rng), _place(whole, rng)))
    return whole[:first] + whole[last:]


def _end(whole: bytes, rng: Rng) -> bytes:
    return whole[: _place(whole, rng)]


def _lines(whole: bytes, rng: Rng) -> bytes:
    """Double, drop or exchange lines."""
    lines = whole.split(b"\n")
    one, other = rng.integers(len(lines), size=2)
    kind = rng.integers(3)
    if kind == 0:
        lines[one:one] = [lines[one]] * int(rng.integers(1, 4))
    elif kind == 1:
        del lines[one]
    else:
        lines[one], lines[other] = lines[other], lines[one]
    return b"\n".join(lines)


def _copy(whole: bytes, rng: Rng) -> bytes:
    """Copy a piece to another place."""
    first, last = sorted((_place(whole, rng), _place(whole, rng)))
    at = _place(whole, rng)
    return whole[:at] + whole[first : min(last, first + 4000)] + whole[at:]


_ACCIDENTS = (_byte, _bit, _replace, _replace, _insert, _number, _number, _cut, _end, _lines, _lines, _copy)
