"""Changes of bytes that find faults in readers."""

from __future__ import annotations

import random

TOKENS = [
    b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"1e308", b"5e-324",
    b"[" * 3000, b"{" * 3000, b"&a [*a, *a]", b"*a", b"\x00", b"\xff\xfe", b'"', b"'''", b"\n\n",
    b",", b"<!ENTITY", b"!!python/object:os.system", b"true", b"null", b"../../../dev/zero", b"\r",
    b"[" * 60_000, b"{a: " * 60_000, b"- " * 60_000, b"<a>" * 60_000,  # deeper than any stack
    b"65535", b"2147483647", b"-2147483648", b"4294967296", b"%s%n", b"1" * 5000,
]  # fmt: skip


def mutated(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A mutation of some bytes: one to four changes."""
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice([1, 2, 4, 8, 40, 400]))
        change = rng.randrange(9)
        if change == 0 and data:  # flip a bit
            place = rng.randrange(len(data))
            data = data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]
        elif change == 1:
            data = data[:at]
        elif change == 2:
            data = data[:at] + data[end:]
        elif change == 3:
            data = data[:at] + data[at:end] * rng.choice([2, 3, 100]) + data[end:]
        elif change == 4:
            data = data[:at] + rng.choice(TOKENS) + data[at:]
        elif change == 5:
            data = data[:at] + rng.choice(TOKENS) + data[end:]
        elif change == 6:
            data = data[:at] + rng.randbytes(rng.choice([1, 4, 16])) + data[end:]
        elif change == 7:
            data = number_changed(data, rng)
        else:
            data = rng.choice(others)
    return data


def number_changed(data: bytes, rng: random.Random) -> bytes:
    """Another number in place of one of a text."""
    digits = [k for k, byte in enumerate(data[:100_000]) if 48 <= byte <= 57]
    if not digits:
        return data
    at = end = rng.choice(digits)
    while end < len(data) and 48 <= data[end] <= 57:
        end += 1
    return data[:at] + rng.choice(TOKENS) + data[end:]
