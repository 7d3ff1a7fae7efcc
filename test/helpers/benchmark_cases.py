"""Tiny pairs whose answer is known, answers made by hand, and the source of methods that fail on purpose."""

import numpy as np

from gapr_core.benchmark.judge import answer_of, judge, pair_facts
from gapr_core.benchmark.record import Record
from gapr_core.benchmark.table import TIMES
from gapr_core.data.pair import Pair
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime.settings import from_dict

FAKES = '''
import os
import time
from dataclasses import replace
import numpy as np
from gapr_core.errors import MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.results import Hypothesis, RegistrationResult, RegistrationStatus

class Fake:
    """The source is made of the target's first points, in order: least squares finds the pose."""

    def __init__(self, name):
        self.name = name

    def prepare(self, target, units="mm"):
        return target

    def register(self, source, target):
        return self.answer(source, target, se3.kabsch(source, target[: len(source)]))

    def answer(self, source, target, T):
        return RegistrationResult(RegistrationStatus.OK, T, np.diag([1e-2] * 3 + [1e-6] * 3), 0.95, method=self.name)

class Turned(Fake):
    """Wrong by half a turn, and sure of it."""

    def answer(self, source, target, T):
        return super().answer(source, target, se3.exp([0, 0, 0, np.pi, 0, 0]) @ T)

class Shy(Fake):
    """Refuses, with the right pose up its sleeve."""

    def answer(self, source, target, T):
        return RegistrationResult(
            RegistrationStatus.AMBIGUOUS, confidence=0.4, reason="two poses", hypotheses=(Hypothesis(T, 0.4),)
        )

class Raising(Fake):
    def answer(self, source, target, T):
        raise RuntimeError("no luck")

class Deadly(Fake):
    """Its library brings the process down on short bones."""

    def answer(self, source, target, T):
        if len(target) < 250:
            os._exit(3)
        return super().answer(source, target, T)

class Slow(Fake):
    def answer(self, source, target, T):
        time.sleep(0.3)
        return super().answer(source, target, T)

class Missing(Fake):
    def prepare(self, target, units="mm"):
        raise MethodUnavailableError("the library nope", "no module", "run: pip install nope")

class Odd(Fake):
    """Answers what cannot be judged or written down."""

    def __init__(self, name, **changes):
        self.name, self.changes = name, changes

    def answer(self, source, target, T):
        said = super().answer(source, target, T)
        return replace(said, **self.changes)

class Nothing(Fake):
    def answer(self, source, target, T):
        return None

good = lambda: Fake("good")
unsure = lambda: Odd("unsure", confidence=float("nan"))
percent = lambda: Odd("percent", confidence=97.0)
boundless = lambda: Odd("boundless", confidence=np.float32("inf"))
wordy = lambda: Odd("wordy", confidence="high")
astray = lambda: Odd("astray", T_target_source=np.full((4, 4), np.nan))
reflecting = lambda: Odd("reflecting", T_target_source=np.diag([1.0, 1.0, -1.0, 1.0]))
vague = lambda: Odd("vague", covariance=np.full((6, 6), np.nan))
dumb = lambda: Nothing("dumb")
turned = lambda: Turned("turned")
shy = lambda: Shy("shy")
raising = lambda: Raising("raising")
deadly = lambda: Deadly("deadly")
slow = lambda: Slow("slow")
missing = lambda: Missing("missing")
nothing = lambda: "a string"
'''


def make_pair(seed, protocol="L1", bone="femur", count=260):
    """A blob of `count` points; the source is its first 120 with 0.3 mm noise, anywhere."""
    rng = np.random.default_rng(seed)
    target = rng.normal(size=(count, 3)) * [80.0, 25.0, 15.0]
    T_source_target = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-100, 100, 3))
    source = se3.apply(T_source_target, target[:120]) + rng.normal(0, 0.3, (120, 3))
    truth = np.full((4, 4), np.nan) if protocol == "wrong" else se3.inverse(T_source_target)
    name = f"{protocol}_{bone}_{seed:04d}"
    metadata = {"noise_mm": 0.3, "overlap": 0.1 + 0.05 * seed}
    return Pair(source, target, truth, name, bone, f"person {seed % 3}", protocol, metadata)


def timeless(rows):
    return [{key: value for key, value in row.items() if key not in TIMES} for row in rows]


def ok(T, confidence=0.8, covariance=None):
    return RegistrationResult(RegistrationStatus.OK, T, covariance, confidence)


def record(pair, result, method="m", seconds=0.5):
    """A record as it comes back from its file."""
    facts = {"method": method, "seconds": seconds, "prepare_seconds": 0.1, "sha256": "0", "file": f"{pair.name}.npz"}
    facts |= {**vars(pair_facts(pair)), **vars(answer_of(result)), **vars(judge(pair, result))}
    return from_dict(Record, Record(**facts).to_json())


def shifted(pair, mm):
    return se3.from_rotation_translation(np.eye(3), [mm, 0, 0]) @ pair.T_target_source


def some_records():
    """Method a: right, refused, false accept with 0.95. Method b: thrice right, less exact. One wrong pair each."""
    pairs = [make_pair(k) for k in range(3)]
    refusal = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.3)
    a = [ok(shifted(pairs[0], 0.5), 0.9), refusal, ok(shifted(pairs[2], 30.0), 0.95)]
    found = [record(pair, result, "a") for pair, result in zip(pairs, a, strict=True)]
    found += [record(pair, ok(shifted(pair, 1.5), 0.7), "b") for pair in pairs]
    wrong = make_pair(7, "wrong")
    return [*found, record(wrong, refusal, "a"), record(wrong, ok(np.eye(4), 0.2), "b")]
