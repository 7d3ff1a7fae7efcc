"""Clouds that were sent and never came."""

from __future__ import annotations

from dataclasses import dataclass

LOST_IN_A_ROW = 20  # a larger gap may be another publisher that was not heard before
MOST_PUBLISHERS = 8  # whose numbers are kept
DOUBTED = 100  # numbers after a jump, in which one that was missed shows that it came from somebody else


@dataclass
class Sender:
    """The numbers of one publisher: the last one, and those around the last jump."""

    last: int
    jump: tuple[int, int] = (0, 0)

    def jumped_over(self, number: int) -> bool:
        """Whether this number is one that was missed not long ago."""
        low, high = self.jump
        return low < number < high and self.last < high + DOUBTED


class Gaps:
    """Finds clouds that were sent and never came, from the numbers that each publisher gives to its messages.

    Which publisher a message is from is not known: a number belongs to the one whose last number is nearest below, or,
    where the gap is large and there are more publishers than were heard, to one that was not heard before. A number
    that comes after it was missed shows that there are two publishers, and no gap.
    """

    def __init__(self) -> None:
        self._heard: list[Sender] = []  # the one heard last at the end

    def note(self, number: int, publishers: int) -> int:
        """By how many numbers more are missing now; negative when some were missed by mistake.

        Args:
            number: of a cloud.
            publishers: how many there are.
        """
        mistaken = sum(self._part(sender) for sender in list(self._heard) if sender.jumped_over(number))
        before = max((sender for sender in self._heard if sender.last < number), key=lambda s: s.last, default=None)
        missing = 0 if before is None else number - before.last - 1
        if before is None or (missing > LOST_IN_A_ROW and len(self._heard) < publishers):
            kept = min(max(publishers, 1), MOST_PUBLISHERS)
            self._heard = [*self._heard, Sender(number)][-kept:]
            return -mistaken
        if missing:
            before.jump = (before.last, number)
        before.last = number
        self._heard.sort(key=lambda sender: sender is before)
        return missing - mistaken

    def _part(self, sender: Sender) -> int:
        """Two publishers were taken for one: how many numbers were missed between theirs."""
        low, high = sender.jump
        sender.jump = (0, 0)
        self._heard.insert(0, Sender(low))
        return high - low - 1
