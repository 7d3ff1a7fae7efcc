"""Damage as disks, networks and attackers do it to files."""

import re

import numpy as np

NUMBERS = [b"0", b"-1", b"1", b"255", b"65536", b"2147483648", b"1000000000000", b"nan", b"1e400", b"foo"]
WORDS = [2**31 - 1, 2**32 - 1, 2**31, 0, 1, 255]


def cut(data, rng):
    """Only the beginning."""
    return data[: rng.integers(0, len(data))]


def flip(data, rng):
    """A few bytes changed."""
    changed = bytearray(data)
    for at in rng.integers(0, len(data), size=rng.integers(1, 9)):
        changed[at] = rng.integers(0, 256)
    return bytes(changed)


def number(data, rng):
    """A number of the text replaced, in the header more often than below."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[: rng.choice([300, 2000, len(data)])]))
    if not found:
        return flip(data, rng)
    which = found[rng.integers(len(found))]
    return data[: which.start()] + NUMBERS[rng.integers(len(NUMBERS))] + data[which.end() :]


def word(data, rng):
    """Four bytes replaced by an extreme count or index."""
    at = int(rng.integers(0, max(1, len(data) - 4)))
    value = WORDS[rng.integers(len(WORDS))]
    return data[:at] + value.to_bytes(4, "little" if rng.random() < 0.6 else "big") + data[at + 4 :]


def remove(data, rng):
    """A piece out of the middle."""
    a, b = sorted(rng.integers(0, len(data), size=2))
    return data[:a] + data[min(b, a + 200) :]


def repeat(data, rng):
    """A piece twice, or many times."""
    a = int(rng.integers(0, len(data)))
    piece = data[a : a + int(rng.integers(1, 80))]
    return data[:a] + piece * int(rng.choice([2, 3, 1000])) + data[a:]


def rename(data, rng):
    """A word of the text replaced by another one of the file."""
    words = list(re.finditer(rb"[A-Za-z_]{2,}", data[:4000]))
    if len(words) < 2:
        return flip(data, rng)
    one, other = (words[i] for i in rng.choice(len(words), 2, replace=False))
    return data[: one.start()] + other[0] + data[one.end() :]


MUTATIONS = (cut, flip, number, word, remove, repeat, rename)


def mutated(data, seed):
    """Names of the damages, joined by `+`, and the damaged file; the same for the same seed."""
    rng = np.random.default_rng(seed)
    kinds = [MUTATIONS[rng.integers(len(MUTATIONS))]]
    damaged = kinds[0](data, rng)
    while len(damaged) > 4 and rng.random() < 0.2:
        kinds.append(MUTATIONS[rng.integers(len(MUTATIONS))])
        damaged = kinds[-1](damaged, rng)
    return "+".join(kind.__name__ for kind in kinds), damaged
